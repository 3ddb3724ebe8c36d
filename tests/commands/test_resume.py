"""Going on with a run: what is recorded, learned from and counted agrees, whatever happened to the files meanwhile."""

import contextlib
import json
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from relmm.commands import record as record_module
from relmm.commands import train as module
from relmm.episodes import DurableDataset, read_episodes, summarize, verify_and_repair
from relmm.episodes.settings import LEROBOT_COLUMNS
from relmm.episodes.sources import Sources
from relmm.learning.progress import read_metrics
from relmm.policies.relmm.learner import ReLMMLearner
from relmm.sim.env import RelmmRoomEnv

Train = Callable[..., str]
LAST_DATA, LAST_EPISODE = "data/*/*.parquet", "meta/episodes/*/*.parquet"


@pytest.fixture(scope="module")
def first_run(run_in, tmp_path_factory, tiny) -> Path:
    """Four navigation steps of a run, of which the middle checkpoint is kept, too."""
    folder = tmp_path_factory.mktemp("resume") / "run"
    result = run_in(
        folder.parent, "relmm-train", *tiny, "--steps=4", "--save_freq=2", "--max_steps=3", f"--output_dir={folder}"
    )
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture
def run(first_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(first_run, tmp_path / "run", symlinks=True))


@pytest.fixture
def call(monkeypatch, capsys) -> Train:
    """relmm-train in this process: what it prints, and `relmm-train: ...` at the end if it refuses."""

    def call(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["relmm-train", *arguments])
        with contextlib.suppress(SystemExit):
            module.main()
        said = capsys.readouterr()
        return str(said.out + said.err)

    return call


@pytest.fixture
def resume(call: Train, run: Path) -> Train:
    return lambda *options: call("--resume=true", f"--output_dir={run}", "--policy.device=cpu", *options)


@pytest.fixture
def learned(monkeypatch) -> list[tuple[int, bool]]:
    """Which recorded episodes are read, and whether the weights learn from them."""
    seen: list[tuple[int, bool]] = []
    read = ReLMMLearner.read

    def note(learner: ReLMMLearner, episode: Any, update: bool) -> None:
        seen.append((episode.index, update))
        read(learner, episode, update)

    monkeypatch.setattr(ReLMMLearner, "read", note)
    return seen


def counters(run: Path, step: str = "last") -> dict[str, int]:
    state = json.loads((run / "checkpoints" / step / "training_state" / "relmm_state.json").read_text())
    counts: dict[str, int] = state["counters"]
    return counts


def newest(root: Path, pattern: str) -> Path:
    return sorted(root.glob(pattern))[-1]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


# --- One cursor ----------------------------------------------------------------------------------------------
def test_a_checkpoint_has_learned_from_whole_episodes(first_run: Path) -> None:
    episodes = list(read_episodes(first_run / "dataset"))
    assert counters(first_run)["episodes"] == len(episodes)
    done = [episode.dones | episode.truncated for episode in episodes]
    assert all(ended[-1] and not ended[:-1].any() for ended in done), "only the last frame of each ends it"
    steps = [int(((e.actions[:, 2].round() == 0) & (e.phases == 1)).sum()) for e in episodes]
    assert sum(steps[: counters(first_run, "000002")["episodes"]]) == 2
    assert sum(steps) == 4


def test_nothing_is_learned_twice(run: Path, resume: Train, learned: list[tuple[int, bool]]) -> None:
    episodes = summarize(run / "dataset").episodes
    resume("--steps=5")
    assert learned == [(index, False) for index in range(episodes)]
    assert counters(run)["episodes"] == summarize(run / "dataset").episodes > episodes


def test_what_came_after_the_checkpoint_is_learned(run: Path, resume: Train, learned: list[tuple[int, bool]]) -> None:
    (run / "checkpoints" / "last").unlink()
    (run / "checkpoints" / "last").symlink_to("000002")
    episodes, cursor = summarize(run / "dataset").episodes, counters(run)["episodes"]
    assert 0 < cursor < episodes
    resume("--steps=4")
    assert learned == [(index, index >= cursor) for index in range(episodes)]
    assert counters(run)["episodes"] == episodes


def test_an_episode_saved_while_the_replay_is_rebuilt_is_learned(
    run: Path, call: Train, learned: list[tuple[int, bool]], monkeypatch, tmp_path: Path
) -> None:
    data, following = run / "dataset", tmp_path / "following"
    options = [f"--dataset.follow={data}", f"--output_dir={following}", "--policy.device=cpu"]
    call(*options, "--steps=4", "--policy.min_attempts_to_update=4", "--replay_frames=2000")
    episodes = summarize(data).episodes
    assert learned == [(index, True) for index in range(episodes)]
    learned.clear()
    read = Sources.read_learned

    def read_beside_a_recorder(sources: Sources) -> Any:
        yield from read(sources)
        shutil.copytree(data, tmp_path / "more")
        with DurableDataset.open(data, "me/life") as dataset:
            for frame in frames_of(tmp_path / "more"):
                dataset.add_frame(*frame)
            dataset.save_episode()

    monkeypatch.setattr(Sources, "read_learned", read_beside_a_recorder)
    call("--resume=true", f"--output_dir={following}", "--steps=5", "--policy.device=cpu")
    assert learned == [*((index, False) for index in range(episodes)), (episodes, True)]
    assert counters(following)["episodes"] == episodes + 1


def frames_of(root: Path) -> list[tuple[dict[str, Any], str]]:
    """The frames of the last episode with navigation steps."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("me/life", root=root)
    drives = [e.index for e in read_episodes(root) if ((e.actions[:, 2].round() == 0) & (e.phases == 1)).any()]
    place = dataset.meta.episodes[drives[-1]]
    frames = []
    for index in range(place["dataset_from_index"], place["dataset_to_index"]):
        item = {key: value for key, value in dataset[index].items() if key in dataset.features}
        picture = (item.pop("observation.images.front").permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        frame = {key: value.numpy().reshape(dataset.features[key]["shape"]) for key, value in item.items()}
        own = {key: value for key, value in frame.items() if key not in LEROBOT_COLUMNS}
        frames.append(({**own, "observation.images.front": picture}, dataset[index]["task"]))
    return frames


# --- Data that is not there ----------------------------------------------------------------------------------
def gone(run: Path) -> None:
    shutil.move(run / "dataset", run / "elsewhere")


def shorter(run: Path) -> None:
    shutil.move(run / "dataset", run / "whole")
    shutil.copytree(run / "whole", run / "dataset")
    for pattern in (LAST_DATA, LAST_EPISODE):
        newest(run / "dataset", pattern).unlink()
    verify_and_repair(run / "dataset")


def another(run: Path) -> None:
    path = run / "dataset" / "meta" / "relmm.json"
    relmm = json.loads(path.read_text())
    relmm["runs"][0]["started"] = "2020-01-01T00:00:00.000+00:00"
    path.write_text(json.dumps(relmm))


@pytest.mark.parametrize("change", [gone, shorter, another])
def test_a_run_does_not_go_on_without_what_it_has_learned_from(run: Path, resume: Train, change) -> None:
    before, episodes = (run / "checkpoints" / "last").readlink(), summarize(run / "dataset").episodes
    change(run)
    files = sorted(path for path in run.rglob("*") if path.name != ".lock")
    *loading, said = resume("--steps=9").splitlines()
    assert loading == ["Loading weights from local directory"]
    assert f"has learned from {episodes} episodes" in said
    have = {gone: "has 0:", shorter: f"has {episodes - 1}:", another: "of another recording than"}[change]
    assert have in said
    assert "bring them back, or begin a new run with --policy.path=" in said
    assert (run / "checkpoints" / "last").readlink() == before
    assert sorted(path for path in run.rglob("*") if path.name != ".lock") == files


def test_a_relative_folder_is_found_from_anywhere(call: Train, tiny, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    call(*tiny, "--steps=1", "--dataset.root=life", "--output_dir=run")
    episodes = summarize(tmp_path / "here" / "life").episodes
    monkeypatch.chdir(tmp_path / "there")
    said = call("--resume=true", "--output_dir=../here/run", "--steps=2", "--policy.device=cpu")
    assert "relmm-train:" not in said
    assert summarize(tmp_path / "here" / "life").episodes > episodes
    assert not any((tmp_path / "there").iterdir())


# --- Damage --------------------------------------------------------------------------------------------------
DAMAGE = {
    "data": lambda root: cut(newest(root, LAST_DATA)),
    "episode": lambda root: cut(newest(root, LAST_EPISODE)),
    "info": lambda root: cut(root / "meta" / "info.json"),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_training_goes_on_after_repairs(run: Path, resume: Train, damage) -> None:
    episodes = summarize(run / "dataset").episodes
    damage(run / "dataset")
    said = resume("--steps=5")
    assert "relmm-train:" not in said
    assert "was cut off" in said or "was rebuilt" in said
    assert counters(run)["episodes"] == summarize(run / "dataset").episodes >= episodes
    assert "relmm-train:" not in resume("--steps=6"), "and again"


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_recording_goes_on_after_repairs(run: Path, damage, monkeypatch, capsys) -> None:
    root = run / "dataset"
    damage(root)
    options = ["--robot.type=locobot_sim", "--robot.room=no_obstacles", "--policy.type=relmm_random"]
    options += ["--dataset.repo_id=local/relmm", f"--dataset.root={root}", "--dataset.num_episodes=1", "--max_steps=2"]
    monkeypatch.setattr(sys, "argv", ["relmm-record", *options, "--resume=true"])
    record_module.main()
    said = capsys.readouterr().out
    assert "was cut off" in said or "was rebuilt" in said
    assert len(list(read_episodes(root))) == summarize(root).episodes


# --- Signals -------------------------------------------------------------------------------------------------
def test_an_evaluation_is_stopped_between_steps_after_the_checkpoint(call: Train, tiny, tmp_path, monkeypatch) -> None:
    steps, step = [], RelmmRoomEnv.step

    def interrupted(env: RelmmRoomEnv, action: Any) -> Any:
        steps.append(sorted(path.name for path in (tmp_path / "run" / "checkpoints").iterdir()))
        signal.raise_signal(signal.SIGTERM)
        return step(env, action)

    monkeypatch.setattr(RelmmRoomEnv, "step", interrupted)
    options = [option for option in tiny if not option.startswith(("--env_eval_freq", "--save_freq"))]
    said = call(*options, "--steps=9", "--env_eval_freq=2", "--save_freq=100", f"--output_dir={tmp_path / 'run'}")
    assert "Stopping: saving what there is" in said
    assert steps == [["000000", "000002", "last"]], "once, and with what was learned saved before"
    assert counters(tmp_path / "run")["episodes"] == summarize(tmp_path / "run" / "dataset").episodes
    assert not any("eval_collected" in line for line in read_metrics(tmp_path / "run" / "metrics.jsonl"))
