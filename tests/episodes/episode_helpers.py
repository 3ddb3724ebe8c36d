"""Frames that tell from which episode and step they are, and the check that a dataset holds exactly those."""

from __future__ import annotations

import numpy as np

from relmm.episodes import DurableDataset, Episode, FrameBuilder
from relmm.features import (
    BELIEF,
    DEPTH_KEY,
    IMAGE_KEY,
    ODOMETRY,
    STATE_KEY,
    STATE_NAMES,
    Phase,
    Skill,
    action_dict,
)

REPO_ID = "tester/clean_room"
INFO = {"room": "no_obstacles", "camera": "paper", "seed": 3}
TASK = "tidy the room"
DATA = "data/chunk-000/file-{:03d}.parquet"
META = "meta/episodes/chunk-000/file-{:03d}.parquet"


def length_of(episode: int) -> int:
    """Frames of an episode: all differ from their neighbours'."""
    return 3 + episode % 5


def picture(episode: int, step: int) -> np.ndarray:
    """Noise, since a picture of one colour compresses to nothing, seeded by episode and step."""
    image = np.random.default_rng([episode, step]).integers(0, 256, (100, 100, 3), dtype=np.uint8)
    image[0, 0] = (episode % 256, step % 256, 77)
    return image


def observation(episode: int, step: int, depth: bool = False) -> dict:
    numbers = {name: episode + step / 1000 + i for i, name in enumerate(STATE_NAMES)}
    pictures = {"front": picture(episode, step)}
    if depth:
        pictures["front_depth"] = np.full((100, 100, 1), 1000 * step + episode, np.uint16)
    return {**numbers, **pictures}


def action(episode: int, step: int) -> dict:
    return action_dict(Skill(step % 3), x_vel=step / 10, theta_vel=episode, x=episode / 8, y=step / 8)


def outcome(episode: int, step: int, length: int) -> dict:
    end, explained = step == length - 1, enumerate((*BELIEF, *ODOMETRY))
    return {
        "next.reward": float(step % 6 == 1) * (1 + episode),
        "next.done": end and episode % 2 == 0,
        "next.truncated": end and episode % 2 == 1,
        "next.success": end and episode % 2 == 0,
        "complementary_info.phase": int(Phase(step % 4)),
        **{f"complementary_info.{name}": episode % 16 / 16 + step / 1024 + i for i, name in explained},
        "complementary_info.robot_time": 100 * episode + 0.5 * step,
        "complementary_info.weights_step": -1,
    }


def arguments(episode: int, step: int, depth: bool = False) -> tuple[dict, dict, dict]:
    """What `EpisodeRecorder.add_frame` takes before the task."""
    return observation(episode, step, depth), action(episode, step), outcome(episode, step, length_of(episode))


def record(dataset: DurableDataset, episodes: range, depth: bool = False) -> None:
    build = FrameBuilder(depth).build
    for episode in episodes:
        for step in range(length_of(episode)):
            dataset.add_frame(build(*arguments(episode, step, depth)), TASK)
        dataset.save_episode()


def record_more(root, episodes: range) -> None:
    """Go on with a dataset."""
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, episodes)


def new_dataset(root, episodes: int, depth: bool = False) -> None:
    """A closed dataset."""
    with DurableDataset.create(REPO_ID, root, depth, "locobot_sim", INFO) as dataset:
        record(dataset, range(episodes), depth)


def check_frame(item: dict, episode: int, step: int, index: int, depth: bool = False) -> None:
    assert int(item["episode_index"]) == episode
    assert int(item["frame_index"]) == step
    assert int(item["index"]) == index
    assert item["task"] == TASK
    pixels = (np.asarray(item[IMAGE_KEY]).transpose(1, 2, 0) * 255).round().astype(np.uint8)
    np.testing.assert_array_equal(pixels, picture(episode, step))
    if depth:
        np.testing.assert_array_equal(np.asarray(item[DEPTH_KEY])[0], np.full((100, 100), 1000 * step + episode))
    state = [episode + step / 1000 + i for i in range(len(STATE_NAMES))]
    np.testing.assert_allclose(np.asarray(item[STATE_KEY]), state, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(item["action"]), list(action(episode, step).values()), rtol=1e-6)
    for key, value in outcome(episode, step, length_of(episode)).items():
        assert float(item[key]) == float(value)


def check_episode(episode: Episode, number: int, source: int | None = None) -> None:
    """The episode has this number, and exactly the frames that were recorded as `source` (the same if None)."""
    source = number if source is None else source
    steps, length = range(length_of(source)), length_of(source)
    outcomes = [outcome(source, step, length) for step in steps]
    assert (episode.index, len(episode)) == (number, length)
    state = [[source + step / 1000 + i for i in range(len(STATE_NAMES))] for step in steps]
    for values, expected, dtype in (
        (episode.images, [picture(source, step) for step in steps], np.uint8),
        (episode.states, state, np.float32),
        (episode.actions, [list(action(source, step).values()) for step in steps], np.float32),
        (episode.rewards, [row["next.reward"] for row in outcomes], np.float32),
        (episode.dones, [row["next.done"] for row in outcomes], np.bool_),
        (episode.truncated, [row["next.truncated"] for row in outcomes], np.bool_),
        (episode.phases, [row["complementary_info.phase"] for row in outcomes], np.int64),
        (episode.grasp_probabilities, [row["complementary_info.grasp_probability"] for row in outcomes], np.float32),
        (episode.robot_times, [row["complementary_info.robot_time"] for row in outcomes], np.float32),
    ):
        assert values.dtype == dtype
        np.testing.assert_array_equal(values, np.asarray(expected, dtype))


def load(root):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(REPO_ID, root=root, video_backend="pyav")


def check_dataset(root, episodes: int, depth: bool = False) -> None:
    """Stock LeRobot reads exactly these episodes, every frame as it was recorded."""
    dataset = load(root)
    assert dataset.num_episodes == episodes
    expected = [(e, s) for e in range(episodes) for s in range(length_of(e))]
    assert len(dataset) == len(expected) == len(dataset.hf_dataset)
    for index, (episode, step) in enumerate(expected):
        check_frame(dataset[index], episode, step, index, depth)


def check_episodes(episodes, numbers) -> None:
    episodes = list(episodes)
    assert [episode.index for episode in episodes] == list(numbers)
    for episode in episodes:
        check_episode(episode, episode.index)
