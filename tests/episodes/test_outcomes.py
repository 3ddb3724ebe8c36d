"""What can be seen of an episode that was recorded without the columns that say how each frame ended."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from episode_helpers import DATA, INFO, REPO_ID, arguments

from relmm.episodes import DurableDataset, EpisodeFollower, FrameBuilder, read_episodes, summarize
from relmm.episodes.outcomes import DERIVED, with_outcomes
from relmm.features import ACTION_NAMES, STATE_KEY, STATE_NAMES, Phase, Skill

# What was done in each frame, drive (d), grasp (g) or place (p), and whether the robot then held something.
EPISODES = (("dgdgpg", (0, 0, 0, 1, 0, 0)), ("ggd", (0, 1, 1)), ("g", (1,)))
SKILLS = {"d": Skill.NAVIGATE, "g": Skill.GRASP, "p": Skill.PLACE}


@pytest.fixture
def stock(tmp_path):
    """A dataset with the columns that LeRobot's own recorder writes."""
    root = tmp_path / "d"
    build = FrameBuilder(False).build
    with DurableDataset.create(REPO_ID, root, False, "locobot_sim", INFO) as dataset:
        for number, (skills, held) in enumerate(EPISODES):
            for step, (skill, before) in enumerate(zip(skills, (0, *held), strict=False)):
                observation, action, outcome = arguments(number, step)
                observation["holding.pos"] = float(before)
                dataset.add_frame(build(observation, action | {"skill.pos": float(SKILLS[skill])}, outcome), "tidy")
            dataset.save_episode()
    info = json.loads((root / "meta/info.json").read_text())
    relmm_only = [key for key in info["features"] if key.startswith(("next.", "complementary_info."))]
    for key in relmm_only:
        del info["features"][key]
    (root / "meta/info.json").write_text(json.dumps(info))
    for path in root.glob("data/*/*.parquet"):
        pq.write_table(pq.read_table(path, partitioning=None).drop_columns(relmm_only), path)
    return root


def test_a_grasp_has_worked_if_something_is_held_in_the_next_frame_of_its_episode(stock):
    episodes = list(read_episodes(stock))
    assert [episode.rewards.tolist() for episode in episodes] == [[0, 0, 0, 1, 0], [0, 1, 0], []]
    assert [len(episode.images) for episode in episodes] == [5, 3, 0], "what came of a last grasp is not known"
    first = episodes[0]
    assert set(first.phases.tolist()) == {Phase.LEARNING}
    assert set(first.grasp_probabilities.tolist()) == {-1.0}
    assert first.robot_times.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert [len(episode) for episode in EpisodeFollower(stock).poll()] == [5, 3, 0]


def test_what_the_robot_refused_was_no_attempt(stock):
    """LeRobot's recorder writes what was commanded: also grasps of a full gripper, placements of an empty one, and what
    a regression makes of a skill."""
    commands = (
        # skill commanded, whether something is held before it, what was done, reward
        (1.0, 0, Skill.GRASP, 1.0),
        (1.0, 1, Skill.NAVIGATE, 0.0),  # holds something already, and still does afterwards
        (2.7, 1, Skill.PLACE, 0.0),
        (2.0, 0, Skill.NAVIGATE, 0.0),
        (-0.8, 0, Skill.NAVIGATE, 0.0),
        (1.0, 0, Skill.GRASP, 0.0),
    )
    path = stock / DATA.format(0)
    table = pq.read_table(path, partitioning=None)
    actions, states = (np.array(table[key].to_pylist(), np.float32) for key in ("action", STATE_KEY))
    actions[:, ACTION_NAMES.index("skill.pos")] = [command for command, *_ in commands]
    states[:, STATE_NAMES.index("holding.pos")] = [holding for _, holding, *_ in commands]
    for key, values in (("action", actions), (STATE_KEY, states)):
        column = pa.array(values.tolist(), table.schema.field(key).type)
        table = table.set_column(table.column_names.index(key), key, column)
    pq.write_table(table, path)
    episode = next(read_episodes(stock))
    assert episode.actions[:, ACTION_NAMES.index("skill.pos")].tolist() == [skill for _, _, skill, _ in commands[:-1]]
    assert episode.rewards.tolist() == [reward for *_, reward in commands[:-1]]
    assert summarize(stock).successful_grasps == 2, "one here and one in the second episode"


def test_only_what_is_missing_is_made(stock):
    table = pq.read_table(stock / DATA.format(0), partitioning=None)
    whole, known = with_outcomes(table, DERIVED)
    assert set(DERIVED) <= set(whole.column_names)
    assert known.tolist() == [True] * 5 + [False]
    again, known = with_outcomes(whole.drop_columns(["complementary_info.phase"]), DERIVED)
    assert known.all()
    assert again["next.reward"].equals(whole["next.reward"])
    assert with_outcomes(table, ())[0] is table
    assert with_outcomes(whole, DERIVED)[0] is whole


def test_the_summary_counts_the_same_successes(stock):
    summary = summarize(stock)
    assert (summary.episodes, summary.frames, summary.grasps, summary.successful_grasps) == (3, 10, 6, 2)
    assert (summary.ended_by_success, summary.truncated) == (0, 3)
    np.testing.assert_allclose(summary.robot_seconds, 2.5 + 1.0)
