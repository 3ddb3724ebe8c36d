"""Datasets whose pictures LeRobot has put into videos."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from episode_helpers import REPO_ID
from lerobot.datasets import LeRobotDataset
from numpy.typing import NDArray

from relmm.episodes import read_episodes
from relmm.errors import DatasetError
from relmm.features import (
    ACTION_NAMES,
    FPS,
    IMAGE_KEY,
    IMAGE_SIZE,
    STATE_KEY,
    STATE_NAMES,
    Skill,
    dataset_features,
)

LENGTHS = (5, 9)
HOLDING = STATE_NAMES.index("holding.pos")


def picture(episode: int, step: int) -> NDArray[np.uint8]:
    """A smooth picture that no other frame has."""
    image = np.full((IMAGE_SIZE, IMAGE_SIZE, 3), (40 * episode + 20, 60, 200), np.uint8)
    cv2.circle(image, (10 + 9 * step, 50), 14, (250, 200, 20), -1)
    return image


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Two episodes as `lerobot-record` writes them, in one video: at step 2 of each something is grasped."""
    root = tmp_path_factory.mktemp("video") / "room"
    wanted = (IMAGE_KEY, STATE_KEY, "action")
    features = {key: feature for key, feature in dataset_features().items() if key in wanted}
    features[IMAGE_KEY] = {**features[IMAGE_KEY], "dtype": "video"}
    dataset = LeRobotDataset.create(REPO_ID, FPS, features, root=root, use_videos=True, video_backend="pyav")
    for episode, length in enumerate(LENGTHS):
        for step in range(length):
            state, action = np.zeros(len(STATE_NAMES), np.float32), np.zeros(len(ACTION_NAMES), np.float32)
            state[HOLDING] = step == 3
            action[ACTION_NAMES.index("skill.pos")] = Skill.GRASP if step == 2 else Skill.NAVIGATE
            frame = {IMAGE_KEY: picture(episode, step), STATE_KEY: state, "action": action}
            dataset.add_frame({**frame, "task": "tidy the room"})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.fixture
def room(recorded, tmp_path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "room"))


def test_each_frame_has_its_own_picture_and_outcome(room):
    episodes = list(read_episodes(room))
    assert [len(episode) for episode in episodes] == list(LENGTHS)
    for number, episode in enumerate(episodes):
        for step, image in enumerate(episode.images):
            errors = [np.abs(image.astype(int) - picture(number, other)).mean() for other in range(len(episode))]
            assert int(np.argmin(errors)) == step
            assert errors[step] < 4
        assert episode.rewards.tolist() == [0, 0, 1] + [0] * (len(episode) - 3)


def test_reading_may_begin_at_a_later_episode(room):
    (episode,) = read_episodes(room, first=1)
    assert len(episode) == LENGTHS[1]
    assert np.abs(episode.images[8].astype(int) - picture(1, 8)).mean() < 4


def test_a_damaged_video_is_named(room):
    (video,) = room.glob("videos/**/*.mp4")
    video.write_bytes(video.read_bytes()[:300])
    with pytest.raises(DatasetError, match=r"picture of episode 0 .* video .*\.mp4 is damaged or too short"):
        list(read_episodes(room))


def test_a_missing_video_is_a_missing_episode(room):
    (video,) = room.glob("videos/**/*.mp4")
    video.unlink()
    with pytest.raises(DatasetError, match=r"episode 0 of .* is missing or cut off"):
        list(read_episodes(room))
