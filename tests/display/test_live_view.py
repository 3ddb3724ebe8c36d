"""What is shown is read back from the file that it was shown in."""

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.experimental import RrdReader

from relmm.display import LiveView
from relmm.features import FRONT, Skill, action_dict
from relmm.geometry import OBJECT_HEIGHT, camera_geometry

CAMERA = camera_geometry("paper")
FLOOR = np.full((20, 20, 3), 90, np.uint8)


def shown(path: Path) -> dict[str, list]:
    """(frame, value) of everything in a recording, by its place and kind."""
    values = defaultdict(list)
    for chunk in RrdReader(path).store().stream().to_chunks():
        batch = chunk.to_record_batch()
        frames = batch["frame"].to_pylist() if "frame" in batch.schema.names else [None] * len(batch)
        for name in batch.schema.names:
            values[f"{chunk.entity_path} {name}"] += zip(frames, batch[name].to_pylist(), strict=True)
    return {name: sorted(each, key=lambda pair: pair[0] or 0) for name, each in values.items()}


@pytest.fixture
def life(tmp_path):
    """A grasp that succeeds, one that fails, and a drive without an opinion."""
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "life.rrd")
    view = LiveView(recording, CAMERA, lambda: FLOOR, lambda action: f"skill {action['skill.pos']:.0f}", learning=True)
    image = {FRONT: np.full((100, 100, 3), 50, np.uint8)}
    grasp, drive = action_dict(Skill.GRASP, x=0.4), action_dict(x_vel=0.2)
    belief = {"grasp_probability": 0.75, "grasp_mean": 0.5, "grasp_std": 0.25}
    outcome = {f"complementary_info.{name}": value for name, value in belief.items()}
    outcome |= {"complementary_info.odom_x": 1.0, "complementary_info.odom_y": 0.0, "next.reward": 1.0}
    view.add_frame(image, grasp, {**outcome, "complementary_info.odom_heading": 90.0}, "")
    view.show(image, grasp, belief, np.array([1.0, 0.5, 0.0]), False)
    view.show(image, drive, {"grasp_probability": 0.125, "grasp_mean": -1.0}, np.array([1.1, 0.5, 0.0]), False)
    view.show_metrics({"steps": 7, "grasp_loss": 0.25, "eval_collected": 0.5, "eval_collected_each": [0.5]})
    recording.disconnect()
    return tmp_path / "life.rrd"


def test_places_are_seen_from_above_with_forward_up(life):
    """Beside a robot at (1, 0) that looks to the left, what lies 0.4 m ahead is at (1, 0.4)."""
    attempts = shown(life)["/where/attempts Points2D:positions"]
    np.testing.assert_allclose(attempts[0][1], [[-0.4, -1.0]], atol=1e-6)
    assert [frame for frame, _ in attempts] == [0, 1, 2]
    np.testing.assert_allclose(attempts[2][1], [[-0.4, -1.0], [-0.5, -1.4]], atol=1e-6)
    (picked_up, failed) = shown(life)["/where/attempts Points2D:colors"][2][1]
    assert picked_up != failed
    (track,) = shown(life)["/where/track LineStrips2D:strips"][2][1]
    np.testing.assert_allclose(track, [[0, -1], [-0.5, -1], [-0.5, -1.1]], atol=1e-6)


def test_the_attempted_spot_is_marked_in_the_picture_only_when_it_grasps(life):
    spots = [value for _, value in shown(life)["/camera/attempt Points2D:positions"]]
    pixel = CAMERA.project(np.array([0.4, 0.0, OBJECT_HEIGHT]))
    np.testing.assert_allclose(spots[:2], [[pixel]] * 2, atol=1e-4)
    assert spots[2] == []


def test_curves_show_what_was_believed_and_what_came_of_it(life):
    values = shown(life)
    assert values["/belief/grasp_probability Scalars:scalars"] == [(0, [0.75]), (1, [0.75]), (2, [0.125])]
    assert values["/belief/grasp_mean Scalars:scalars"] == [(0, [0.5]), (1, [0.5])]
    assert values["/success/of_the_last_50_attempts Scalars:scalars"] == [(0, [1.0]), (1, [0.5])]
    assert values["/objects/picked_up Scalars:scalars"] == [(0, [1.0]), (1, [1.0])]
    assert values["/learning/grasp_loss Scalars:scalars"] == [(2, [0.25])]
    assert values["/learning/eval_collected Scalars:scalars"] == [(2, [0.5])]
    assert not any("steps" in name or "each" in name for name in values)


def test_pictures_and_words_come_with_every_frame_and_the_layout_with_the_first(life):
    values = shown(life)
    for name in ("/camera EncodedImage:blob", "/floor EncodedImage:blob"):
        assert [frame for frame, _ in values[name]] == [0, 1, 2]
    assert [value for _, value in values["/doing TextDocument:text"]] == [["skill 1"], ["skill 1"], ["skill 0"]]
    (layout,) = RrdReader(life).blueprints()
    assert layout.application_id == "test"
