"""Sharing from the command line: what is uploaded when, and going on on another machine."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from relmm.commands import record, train, upload
from relmm.commands.sharing import Uploads, dataset_arguments
from relmm.episodes import read_episodes, summarize
from relmm.errors import HubError

TINY = [
    "--robot.type=locobot_sim",
    "--policy.device=cpu",
    "--policy.num_stationary=6",
    "--policy.min_attempts_to_update=4",
    "--policy.min_steps_to_update=4",
    "--policy.navigation_batch_size=8",
    "--policy.grasp_batch_size=8",
    "--policy.random_steps=2",
    "--pseudo_reset_steps=2",
    "--replay_frames=2000",
    "--env_eval_freq=0",
    "--log_freq=2",
    "--save_freq=4",
    "--max_steps=3",
]
SHARED = (
    "--policy.push_to_hub=true",
    "--policy.repo_id=me/policy",
    "--dataset.push_to_hub=true",
    "--dataset.repo_id=me/life",
)
ONLINE = {"HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_PROGRESS_BARS": "1"}
SAMPLE = Path(__file__).parents[2] / "datasets" / "diverse_scripted"


@pytest.fixture
def call(monkeypatch, capsys):
    """Run a command in this process; its exit status and what it printed."""

    def run(main, *arguments):
        monkeypatch.setattr(sys, "argv", ["command", *arguments])
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = stop.code
        captured = capsys.readouterr()
        return status, captured.out, captured.err.strip()

    return run


@pytest.fixture
def refused(call, tmp_path):
    """The one sentence in which relmm-train ends before it writes anything."""

    def run(*arguments):
        status, _, errors = call(train.main, *TINY, *arguments, f"--output_dir={tmp_path / 'out'}")
        assert status == 2
        assert len(errors.splitlines()) == 1
        assert not (tmp_path / "out").exists()
        return errors

    return run


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--policy.push_to_hub=true"], "--policy.push_to_hub=true --policy.repo_id=user/name"),
        (["--policy.push_to_hub=true", "--policy.repo_id=nobody"], "the user is missing"),
        (["--dataset.push_to_hub=true"], "which is on this machine only"),
        (["--hub.every=10"], "but nothing is uploaded"),
        (["--hub.every=-1"], "hub.every is -1"),
        ([*SHARED, "--policy.repo_id=you/policy"], "does not let you use the model you/policy"),
    ],
)
def test_settings_that_cannot_work(hub, refused, arguments, words):
    assert words in refused(*arguments)


def test_names_that_are_taken_are_refused_before_the_run(hub, refused):
    hub.create("me/policy", files={"config.json": b"{}"})
    assert "the model me/policy on the Hub is another run's already" in refused(*SHARED)


def test_nobody_uploads_without_being_asked(hub, call, tmp_path):
    status, _, errors = call(
        record.main,
        "--robot.type=locobot_sim",
        "--policy.type=relmm_random",
        "--max_steps=2",
        "--dataset.num_episodes=1",
        "--dataset.repo_id=me/room",
        f"--dataset.root={tmp_path / 'room'}",
    )
    assert status == 0, errors
    assert not hub.requests


@pytest.fixture
def background(hub, monkeypatch):
    """Uploads of the sample dataset, in processes that may reach the Hub, and what they say."""
    for name, value in ONLINE.items():
        monkeypatch.setenv(name, value)
    said = []
    return Uploads(dataset_arguments("me/room", SAMPLE, True, "cc0-1.0"), SAMPLE, said.append), said


def test_uploads_in_the_background(hub, fault, background):
    uploads, said = background
    hub.faults.append(fault("/repos/create", status=500))
    uploads.begin()
    uploads.begin()
    assert said == ["upload: the last one is still under way; the next one takes what is new by then."]
    uploads._process.wait()
    uploads.check()
    assert said[1].startswith("upload: nothing was uploaded: the transfer of the dataset me/room has failed")
    assert said[1].endswith("; try again. The run goes on; the next upload tries again.")
    hub.faults.clear()
    uploads.begin()
    uploads._process.wait()
    uploads.check()
    assert len(said) == 2, "an upload that works says nothing"
    repo = hub.repo("me/room", "datasets")
    assert repo.tags["v3.0"] == repo.refs["main"]
    assert repo.private
    assert b"license: cc0-1.0" in repo.files["README.md"]


def test_the_last_upload(hub, fault, background):
    uploads, said = background
    hub.faults.append(fault("/repos/create", cut=True))
    with pytest.raises(HubError) as caught:
        uploads.finish()
    assert "\n" not in str(caught.value)
    command = f"relmm-upload --dataset.repo_id=me/room --dataset.root={SAMPLE} --dataset.private=true"
    assert f"Everything is saved in {SAMPLE}; upload it later with: {command}" in str(caught.value)
    hub.faults.clear()
    uploads.finish()
    assert said[0] == "Uploading to the Hub; Ctrl-C leaves it for later."
    assert said[-1].startswith("dataset, 10 episodes: http://127.0.0.1")


def test_upload_again_by_hand(hub, call):
    status, printed, errors = call(upload.main, "--dataset.repo_id=me/room", f"--dataset.root={SAMPLE}")
    assert status == 0, errors
    assert "dataset, 10 episodes" in printed
    for arguments, words in (
        ([], "Say what to upload"),
        (["--dataset.repo_id=me/room"], "--output_dir=FOLDER of a run"),
        (["--policy.repo_id=me/policy", "--output_dir=nowhere"], "There is no checkpoint in nowhere"),
    ):
        status, _, errors = call(upload.main, *arguments)
        assert status == 2
        assert words in errors


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_going_on_on_another_machine(hub, run, tmp_path):
    def relmm(command, *arguments, home="here"):
        result = run("python", "-m", f"relmm.commands.{command}", *arguments, **ONLINE, HF_HOME=str(tmp_path / home))
        assert result.returncode == 0, result.stderr
        return result

    trained = relmm("train", *TINY, *SHARED, "--steps=8", "--hub.every=4", "--seed=3", "--output_dir=first")
    assert "policy, step 8: http://127.0.0.1" in trained.stdout
    evaluation = ("--env.type=relmm_room", "--policy.device=cpu", "--env.navigation_steps=20", "--eval.n_episodes=2")
    relmm("evaluate", *evaluation, "--policy.path=first/checkpoints/last/pretrained_model", "--output_dir=eval_here")
    relmm("evaluate", *evaluation, "--policy.path=me/policy", "--output_dir=eval_there", home="hf_there")
    here, there = (json.loads((tmp_path / f"eval_{place}/eval_info.json").read_text()) for place in ("here", "there"))
    assert here == there

    resume = ("--resume=true", "--steps=14", "--policy.device=cpu")
    relmm("train", *resume, "--policy.path=me/policy", "--output_dir=there", home="hf_there")
    no_push = ("--policy.push_to_hub=false", "--dataset.push_to_hub=false", "--hub.every=0")
    relmm("train", *resume, *no_push, "--output_dir=first")
    for name in ("pretrained_model/model.safetensors", "training_state/navigation/optimizer_state.safetensors"):
        mine, theirs = (tmp_path / place / "checkpoints/last" / name for place in ("first", "there"))
        assert mine.read_bytes() == theirs.read_bytes()
    mine, theirs = (list(read_episodes(tmp_path / place / "dataset")) for place in ("first", "there"))
    assert len(mine) == len(theirs) > summarize_hub(hub)
    for one, other in zip(mine, theirs, strict=True):
        assert np.array_equal(one.images, other.images)
        assert np.array_equal(one.actions, other.actions)
    assert hub.repo("me/policy").files["training_state/training_step.json"] == b'{\n    "step": 8\n}', "nobody asked"


def summarize_hub(hub) -> int:
    return json.loads(hub.repo("me/life", "datasets").files["meta/info.json"])["total_episodes"]


STREAM = """
import sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

loaded = LeRobotDataset("me/room", video_backend="pyav")
streamed = sorted(StreamingLeRobotDataset("me/room", shuffle=False), key=lambda item: int(item["index"]))
assert len(loaded) == len(streamed)
for mine, item in zip(loaded, streamed):
    assert (mine["observation.images.front"] == item["observation.images.front"]).all()
    assert (mine["action"] == item["action"]).all()
print(len(loaded), loaded.num_episodes)
"""


@pytest.mark.slow
def test_lerobot_loads_and_streams_it_on_another_machine(hub, call, run, tmp_path):
    status, _, errors = call(upload.main, "--dataset.repo_id=me/room", f"--dataset.root={SAMPLE}")
    assert status == 0, errors
    result = run("python", "-c", STREAM, **ONLINE, HF_HOME=str(tmp_path / "hf_there"))
    assert result.returncode == 0, result.stderr
    summary = summarize(SAMPLE)
    assert result.stdout.split() == [str(summary.frames), str(summary.episodes)]
