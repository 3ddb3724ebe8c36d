"""What can be seen of an episode that was recorded without the columns that say how each frame ended."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from episode_helpers import DATA, INFO, REPO_ID, arguments

from relmm.episodes import DurableDataset, EpisodeFollower, FrameBuilder, read_episodes, summarize
from relmm.episodes.outcomes import DERIVED, with_outcomes
from relmm.features import Phase, Skill

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
