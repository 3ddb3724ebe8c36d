"""Frames that tell from which episode and step they are, and the check that a dataset holds exactly those."""

from __future__ import annotations

import numpy as np

from relmm.episodes import DurableDataset, FrameBuilder
from relmm.features import DEPTH_KEY, IMAGE_KEY, STATE_KEY, STATE_NAMES, Phase, Skill, action_dict

REPO_ID = "tester/clean_room"
INFO = {"room": "no_obstacles", "camera": "paper", "seed": 3}
TASK = "tidy the room"


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
    end = step == length - 1
    return {
        "next.reward": float(step % 6 == 1),
        "next.done": end and episode % 2 == 0,
        "next.truncated": end and episode % 2 == 1,
        "next.success": end and episode % 2 == 0,
        "complementary_info.phase": int(Phase(step % 4)),
        "complementary_info.grasp_probability": -1.0,
        "complementary_info.robot_time": 0.5 * step,
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
