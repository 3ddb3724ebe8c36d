"""LeRobot's own commands, unmodified, on relmm's robot, policies, environment and datasets."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from relmm.analysis import collect
from relmm.episodes import read_episodes, summarize
from relmm.features import ACTION_NAMES, STATE_NAMES, Skill

ROBOT = ("--robot.type=locobot_sim", "--robot.room=diverse")


@pytest.fixture(scope="module")
def recorded(run_in, tmp_path_factory) -> Path:
    """A small dataset written by relmm-record."""
    folder = tmp_path_factory.mktemp("recorded")
    arguments = ["--policy.type=relmm_random", "--max_steps=4", "--dataset.num_episodes=3"]
    dataset = ["--dataset.repo_id=me/room", "--dataset.root=room"]
    assert run_in(folder, "relmm-record", *ROBOT, *arguments, *dataset).returncode == 0
    return folder / "room"


@pytest.mark.slow
def test_what_lerobot_record_has_recorded_can_be_learned_from(run, tmp_path):
    """At LeRobot's own frame rate, and without the columns that only relmm writes."""
    result = run(
        "lerobot-record",
        "--robot.type=locobot_sim",
        "--robot.room=no_obstacles",
        "--teleop.type=locobot_scripted",
        "--dataset.repo_id=me/room",
        "--dataset.root=room",
        "--dataset.single_task=Clean the room",
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=12",
        "--dataset.reset_time_s=0",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    assert result.returncode == 0, result.stderr
    table = pq.read_table(tmp_path / "room/data/chunk-000/file-000.parquet")
    assert "next.reward" not in table.column_names
    actions, states = np.array(table["action"].to_pylist()), np.array(table["observation.state"].to_pylist())
    assert actions.shape[1] == len(ACTION_NAMES)
    assert states.shape[1] == len(STATE_NAMES)
    (episode,) = read_episodes(tmp_path / "room")
    placed = (
        actions[1:, ACTION_NAMES.index("skill.pos")] == Skill.PLACE
    )  # what the controller does when it holds something
    assert episode.rewards[: len(placed)].sum() == placed.sum() > 0
    assert summarize(tmp_path / "room").successful_grasps == placed.sum()
    analysed = collect(tmp_path / "room", tmp_path / "report")
    assert analysed.notes == []
    assert analysed.grasps["success"].sum() == placed.sum()
    assert analysed.grasps["light"].between(0.05, 1).all(), "each has its picture"
    result = run(
        "relmm-train",
        "--robot.type=locobot_sim",
        "--robot.room=no_obstacles",
        "--dataset.init=room",
        "--policy.device=cpu",
        "--curriculum.type=none",
        "--steps=1",
        "--env_eval_freq=0",
        "--output_dir=learned",
    )
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "learned/checkpoints/last/pretrained_model/model.safetensors").exists()
    result = run(
        "lerobot-train",
        "--policy.type=relmm",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=me/room",
        "--dataset.root=room",
        "--batch_size=64",
        "--num_workers=0",
        "--steps=1",
        "--log_freq=1",
        "--env_eval_freq=0",
        "--output_dir=stock",
    )
    assert result.returncode == 0, result.stderr
    assert "loss:0.000" not in result.stderr + result.stdout, "it has found attempts that it could learn from"


def test_lerobot_replay(run, recorded):
    result = run(
        "lerobot-replay",
        *ROBOT,
        "--dataset.repo_id=me/room",
        f"--dataset.root={recorded}",
        "--dataset.episode=0",
        "--play_sounds=false",
    )
    assert result.returncode == 0, result.stderr


def test_lerobot_rollout_from_a_saved_policy(run, tmp_path):
    from relmm.commands.policies import make_actor
    from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig

    make_actor(RelmmScriptedConfig(device="cpu")).save_pretrained(tmp_path / "policy")
    result = run(
        "lerobot-rollout",
        *ROBOT,
        "--policy.path=policy",
        "--strategy.type=base",
        "--duration=3",
        "--fps=2",
        "--task=Clean the room",
    )
    assert result.returncode == 0, result.stderr
    assert "Rollout finished" in result.stderr + result.stdout


def test_lerobot_edit_dataset_deletes_an_episode(run, recorded, tmp_path):
    result = run(
        "lerobot-edit-dataset",
        "--repo_id=me/room",
        f"--root={recorded}",
        "--new_repo_id=me/shorter",
        "--new_root=shorter",
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[1]",
    )
    assert result.returncode == 0, result.stderr
    episodes = pq.read_table(tmp_path / "shorter/meta/episodes")
    assert episodes.num_rows == 2


def test_lerobot_dataset_viz_saves_a_recording(run, recorded, tmp_path):
    result = run(
        "lerobot-dataset-viz",
        "--repo-id=me/room",
        f"--root={recorded}",
        "--episode-index=0",
        "--save=1",
        "--output-dir=viz",
        "--num-workers=0",
    )
    assert result.returncode == 0, result.stderr
    assert list((tmp_path / "viz").glob("*.rrd"))


def test_lerobot_eval_in_parallel_processes(run):
    result = run(
        "lerobot-eval",
        "--policy.type=relmm_random",
        "--env.type=relmm_room",
        "--env.navigation_steps=5",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--output_dir=out",
    )
    assert result.returncode == 0, result.stderr
