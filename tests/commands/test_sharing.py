"""Sharing from the command line: what is uploaded when, and going on on another machine."""

import json
import resource
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from relmm.commands import record, train, upload
from relmm.commands.arguments import Arguments
from relmm.commands.hub_resume import take_over_from_hub
from relmm.commands.policies import make_actor
from relmm.commands.sharing import Uploads, dataset_arguments
from relmm.episodes import read_episodes, summarize, upload_dataset
from relmm.episodes.folder import DatasetFolder
from relmm.episodes.upload import recorded_runs
from relmm.errors import HubError
from relmm.learning.checkpoint import save_checkpoint
from relmm.learning.hub import upload_checkpoint
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

SHARED = (
    "--policy.push_to_hub=true",
    "--policy.repo_id=me/policy",
    "--dataset.push_to_hub=true",
    "--dataset.repo_id=me/life",
)
ONLINE = {"HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_PROGRESS_BARS": "1"}
SAMPLE = Path(__file__).parents[2] / "datasets" / "first_attempts"


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
def refused(call, tmp_path, tiny):
    """The one sentence in which relmm-train ends before it writes anything."""

    def run(*arguments):
        status, _, errors = call(train.main, *tiny, "--max_steps=3", *arguments, f"--output_dir={tmp_path / 'out'}")
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


@pytest.mark.slow
def test_a_recording_is_uploaded_when_asked(hub, call, tmp_path, monkeypatch):
    for name, value in ONLINE.items():
        monkeypatch.setenv(name, value)
    status, printed, errors = call(
        record.main,
        "--robot.type=locobot_sim",
        "--policy.type=relmm_random",
        "--max_steps=2",
        "--dataset.num_episodes=2",
        "--dataset.repo_id=me/room",
        f"--dataset.root={tmp_path / 'room'}",
        "--dataset.push_to_hub=true",
        "--dataset.private=true",
    )
    assert status == 0, errors
    assert "dataset, 2 episodes: http://127.0.0.1" in printed
    assert hub.repo("me/room", "datasets").private


def published_run(hub, tmp_path) -> None:
    """A checkpoint, of which no weight is trained, and the sample dataset, as its own."""
    dataset = upload_dataset(SAMPLE, "me/life")
    actor = make_actor(ReLMMConfig(device="cpu", num_members=2, channels=4))
    learner = actor.policy.make_learner(seed=0, capacity=1000)
    settings = {"policy": {"type": "relmm"}, "dataset": {"repo_id": "me/life"}}
    counters = {"episodes": 70, "interventions": 0}
    saved = save_checkpoint(tmp_path / "saved", 7, actor, learner, np.random.default_rng(0), counters, settings, [])
    runs = recorded_runs(DatasetFolder(SAMPLE))
    upload_checkpoint(saved, "me/policy", private=None, dataset=dataset, runs=runs, decorate=lambda folder: None)


def test_recording_with_a_policy_of_the_hub(hub, call, tmp_path):
    published_run(hub, tmp_path)
    revision = hub.repo("me/policy").refs["main"]
    hub.repo("me/policy").commit({"config.json": b"{}"})
    status, _, errors = call(
        record.main,
        "--robot.type=locobot_sim",
        f"--policy.path=me/policy@{revision}",
        "--policy.device=cpu",
        "--max_steps=2",
        "--dataset.num_episodes=1",
        "--dataset.repo_id=me/room",
        f"--dataset.root={tmp_path / 'room'}",
    )
    assert status == 0, errors
    run = json.loads((tmp_path / "room/meta/relmm.json").read_text())["runs"][0]
    assert (run["policy"], run["policy_path"]) == ("relmm", f"me/policy@{revision}")


def with_info(**changes):
    def damage(files):
        files["meta/info.json"] = json.dumps(json.loads(files["meta/info.json"]) | changes).encode()

    return damage


def without_end(files):
    files["data/chunk-000/file-000.parquet"] = files["data/chunk-000/file-000.parquet"][:-100]


def other_action(files):
    features = json.loads(files["meta/info.json"])["features"]
    features["action"]["shape"] = [7]
    with_info(features=features)(files)


DAMAGED_DATASETS = {
    "version": (with_info(codebase_version="v2.1"), "format: have v2.1, want v3.0"),
    "shape": (other_action, "column action: have float32 (7,) of"),
    "path": (with_info(data_path="/etc/{file_index}"), "data_path: have /etc/"),
    "cut": (without_end, "me/life on the Hub is damaged (no whole episode can be read from it"),
    "fewer episodes": (lambda files: files.pop("meta/episodes/chunk-000/file-000.parquet"), "on the Hub is damaged"),
}


@pytest.mark.parametrize(("damage", "words"), DAMAGED_DATASETS.values(), ids=DAMAGED_DATASETS)
def test_a_run_with_a_damaged_dataset_is_refused(hub, call, tmp_path, damage, words):
    published_run(hub, tmp_path)
    repo = hub.repo("me/life", "datasets")
    damage(repo.commits[repo.refs["main"]])
    out = tmp_path / "out"
    status, _, errors = call(train.main, "--resume=true", "--policy.path=me/policy", f"--output_dir={out}")
    assert status == 2
    assert words in errors.splitlines()[-1]
    assert errors.splitlines()[-1].startswith("relmm-train: ")
    assert not out.exists()
    assert not list(tmp_path.glob(".out*"))


def test_a_disk_that_is_full_while_a_run_is_taken_over(hub, call, tmp_path):
    published_run(hub, tmp_path)
    out = tmp_path / "out"
    arguments = ("--resume=true", "--policy.path=me/policy", f"--output_dir={out}")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond it then fails with EFBIG
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        status, _, errors = call(train.main, *arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert status == 2
    assert "make room on the disk and try again" in errors.splitlines()[-1]
    assert not out.exists()
    command_line = Arguments(arguments)
    take_over_from_hub(command_line)
    assert summarize(out / "dataset").episodes == 70, "a later attempt completes"
    assert command_line.words == ["--resume=true", f"--output_dir={out}"], "the rest resumes a local run"


@pytest.fixture
def background(hub, monkeypatch):
    """Uploads of the sample dataset, in processes that may reach the Hub, and what they say."""
    for name, value in ONLINE.items():
        monkeypatch.setenv(name, value)
    said = []
    return Uploads(dataset_arguments("me/room", SAMPLE, True, "cc0-1.0"), SAMPLE, said.append), said


@pytest.mark.slow
def test_uploads_in_the_background(hub, fault, background):
    uploads, said = background
    hub.faults.append(fault("/repos/create", status=500))
    uploads.begin()
    uploads.begin()
    assert said == ["upload: the last one is still under way; the next one takes what is new by then."]
    uploads._upload._process.wait()
    uploads.check()
    assert said[1].startswith("upload: nothing was uploaded: the transfer of the dataset me/room has failed")
    assert said[1].endswith("; try again. The run goes on; the next upload tries again.")
    hub.faults.clear()
    uploads.begin()
    uploads._upload._process.wait()
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
    assert said[-1].startswith("dataset, 70 episodes: http://127.0.0.1")


@pytest.mark.slow
def test_the_last_upload_takes_the_place_of_one_under_way(hub, fault, background, tmp_path, monkeypatch):
    uploads, said = background
    (tmp_path / "copies").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "copies"))
    slow = fault("/preupload/", delay_s=60, times=1)
    hub.faults.append(slow)
    uploads.begin()
    while not slow.hits:
        time.sleep(0.05)
    assert len(list((tmp_path / "copies").glob("relmm-upload-*"))) == 1
    started = time.monotonic()
    uploads.finish()
    assert time.monotonic() - started < 50
    assert said[-1].startswith("dataset, 70 episodes: ")
    assert not list((tmp_path / "copies").glob("relmm-upload-*")), "also the copy of the one that was ended"


def test_upload_again_by_hand(hub, call):
    status, printed, errors = call(upload.main, "--dataset.repo_id=me/room", f"--dataset.root={SAMPLE}")
    assert status == 0, errors
    assert "dataset, 70 episodes" in printed
    for arguments, words in (
        ([], "Say what to upload"),
        (["--dataset.repo_id=me/room"], "--output_dir=FOLDER of a run"),
        (["--policy.repo_id=me/policy", "--output_dir=nowhere"], "There is no checkpoint in nowhere"),
    ):
        status, _, errors = call(upload.main, *arguments)
        assert status == 2
        assert words in errors


@pytest.mark.slow
def test_going_on_on_another_machine(hub, run, tmp_path, tiny):
    def relmm(command, *arguments, home="here"):
        result = run("python", "-m", f"relmm.commands.{command}", *arguments, **ONLINE, HF_HOME=str(tmp_path / home))
        assert result.returncode == 0, result.stderr
        return result

    trained = relmm(
        "train", *tiny, "--max_steps=3", *SHARED, "--steps=8", "--hub.every=4", "--seed=3", "--output_dir=first"
    )
    assert "policy: http://127.0.0.1" in trained.stdout
    evaluation = ("--env.type=relmm_room", "--policy.device=cpu", "--env.navigation_steps=20", "--eval.n_episodes=2")
    relmm("evaluate", *evaluation, "--policy.path=first/checkpoints/last/pretrained_model", "--output_dir=eval_here")
    relmm("evaluate", *evaluation, "--policy.path=me/policy", "--output_dir=eval_there", home="hf_there")
    here, there = (json.loads((tmp_path / f"eval_{place}/eval_info.json").read_text()) for place in ("here", "there"))
    assert here == there

    resume = ("--resume=true", "--steps=14", "--policy.device=cpu")
    relmm("train", *resume, "--policy.path=me/policy", "--output_dir=there", home="hf_there")
    no_push = ("--policy.push_to_hub=false", "--dataset.push_to_hub=false", "--hub.every=0")
    relmm("train", *resume, *no_push, "--output_dir=first")
    for name in ("pretrained_model/model.safetensors", "training_state/grasping/optimizer_state.safetensors"):
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
def test_lerobot_loads_streams_and_trains_from_it_on_another_machine(hub, call, run, tmp_path):
    status, _, errors = call(upload.main, "--dataset.repo_id=me/room", f"--dataset.root={SAMPLE}")
    assert status == 0, errors
    result = run("python", "-c", STREAM, **ONLINE, HF_HOME=str(tmp_path / "hf_there"))
    assert result.returncode == 0, result.stderr
    summary = summarize(SAMPLE)
    assert result.stdout.split() == [str(summary.frames), str(summary.episodes)]
    trained = run(
        "lerobot-train",
        *("--policy.type=relmm", "--policy.device=cpu", "--policy.push_to_hub=false", "--output_dir=streamed"),
        *("--dataset.repo_id=me/room", "--dataset.streaming=true", "--batch_size=4", "--num_workers=1", "--steps=2"),
        **ONLINE,
        HF_HOME=str(tmp_path / "hf_elsewhere"),
    )
    assert trained.returncode == 0, trained.stderr
    assert (tmp_path / "streamed/checkpoints/last/pretrained_model/model.safetensors").is_file()
