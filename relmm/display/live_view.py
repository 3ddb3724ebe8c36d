"""A robot's life as it happens, for a viewer of rerun: https://rerun.io."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.display.layout import (
    ATTEMPT,
    ATTEMPTS,
    BELIEF,
    CAMERA,
    DOING,
    FLOOR,
    FRAME,
    LEARNING,
    OBJECTS,
    ROBOT,
    SUCCESS,
    TRACK,
    blueprint,
)
from relmm.features import BELIEF as BELIEFS
from relmm.features import FRONT, ODOMETRY, FloatArray, Skill
from relmm.geometry import OBJECT_HEIGHT, CameraGeometry, moved

_RECENT = 50  # attempts that a success rate is of
_NOSE = 0.25  # m, how far the robot's arrow reaches
_GREY, _BLUE = (130, 140, 155), (60, 120, 240)  # RGB
_COLOURS = {True: (30, 160, 60), False: (230, 60, 60)}  # of successful and failed attempts
_LATELY = 500  # frames of the track, which is sent whole with each frame
_QUALITY = 75  # JPEG quality: a long run has many pictures


class LiveView:
    """Shows frame after frame; takes them as a recorder of `relmm.learning.life.Life` does.

    Args:
        recording: a `rerun.RecordingStream` that leads to a viewer or a file.
        camera: of the robot.
        picture: what the policy thinks, see `relmm.learning.actor.Actor.picture`.
        describe: what an action is for, see `relmm.learning.actor.Actor.describe`.
        learning: whether metrics will come.
    """

    def __init__(
        self,
        recording: Any,
        camera: CameraGeometry,
        picture: Callable[[], NDArray[np.uint8] | None],
        describe: Callable[[dict[str, float]], str],
        learning: bool,
    ) -> None:
        self._recording, self._camera = recording, camera
        self._picture, self._describe, self._learning = picture, describe, learning
        self._frames = self._picked_up = 0
        self._recent: deque[bool] = deque(maxlen=_RECENT)
        self._track: deque[FloatArray] = deque(maxlen=_LATELY)
        self._attempts: deque[tuple[FloatArray, bool]] = deque(maxlen=_LATELY)

    def add_frame(
        self, observation: dict[str, Any], action: dict[str, float], outcome: dict[str, Any], task: str
    ) -> None:
        """Show a recorded frame."""
        x, y, heading = (outcome[f"complementary_info.{name}"] for name in ODOMETRY)
        belief = {name: outcome[f"complementary_info.{name}"] for name in BELIEFS}
        self.show(observation, action, belief, np.array([x, y, np.radians(heading)]), outcome["next.reward"] > 0)

    def save_episode(self) -> None:
        """Nothing to do: it goes on."""

    def cut_episode(self) -> None:
        """Nothing to do: it goes on."""

    def begin_anew(self) -> None:
        """Forget where the robot was: it is in another room now."""
        self._track.clear()
        self._attempts.clear()

    def show(
        self,
        observation: Mapping[str, Any],
        action: dict[str, float],
        belief: Mapping[str, float],
        pose: FloatArray,
        success: bool,
    ) -> None:
        """Show one frame, just after its action.

        Args:
            observation: of the robot, before it.
            action: one skill.
            belief: by `relmm.features.BELIEF`; what is missing or below 0 is no opinion.
            pose: of the robot before it, by its wheels: m, m, rad.
            success: whether it picked something up.
        """
        picture = self._picture()
        if self._frames == 0:
            self._recording.send_blueprint(blueprint(picture is not None, self._learning))
        self._recording.set_time(FRAME, sequence=self._frames)
        self._frames += 1
        spot = np.array([action["skill_x.pos"], action["skill_y.pos"]]) if _is_grasp(action) else None
        self._show_pictures(observation[FRONT], picture, spot)
        self._show_place(pose, spot, success)
        self._show_curves(belief, success if spot is not None else None)
        self._log(DOING, "TextDocument", self._describe(action))

    def show_metrics(self, values: Mapping[str, Any]) -> None:
        """Show a line of the metrics: losses and evaluations, for the rest is seen from the frames."""
        for name, value in values.items():
            if isinstance(value, float) and ("loss" in name or name.startswith("eval_")):
                self._log(f"{LEARNING}/{name}", "Scalars", value)

    def _log(self, place: str, kind: str, *values: Any, **more: Any) -> None:
        import rerun as rr

        self._recording.log(place, getattr(rr, kind)(*values, **more))

    def _show_pictures(
        self, image: NDArray[np.uint8], picture: NDArray[np.uint8] | None, spot: FloatArray | None
    ) -> None:
        import rerun as rr

        self._recording.log(CAMERA, rr.Image(image).compress(jpeg_quality=_QUALITY))
        pixels = [] if spot is None else [self._camera.project(np.array([*spot, OBJECT_HEIGHT]))]
        self._log(ATTEMPT, "Points2D", pixels, radii=-6.0, colors=[_BLUE])
        if picture is not None:
            self._recording.log(FLOOR, rr.Image(picture).compress(jpeg_quality=_QUALITY))

    def _show_place(self, pose: FloatArray, spot: FloatArray | None, success: bool) -> None:
        here, ahead = _seen_from_above(pose), _seen_from_above(moved(pose, np.array([_NOSE, 0.0, 0.0])))
        self._track.append(here)
        if spot is not None:
            self._attempts.append((_seen_from_above(moved(pose, np.array([*spot, 0.0]))), success))
        places, colours = [each[0] for each in self._attempts], [_COLOURS[each[1]] for each in self._attempts]
        # Negative radii are points of the screen, whatever the scale.
        self._log(TRACK, "LineStrips2D", [list(self._track)], radii=-1.0, colors=[_GREY])
        self._log(ATTEMPTS, "Points2D", places, radii=-3.0, colors=colours)
        self._log(ROBOT, "Arrows2D", origins=[here], vectors=[ahead - here], radii=-2.0, colors=[_BLUE])

    def _show_curves(self, belief: Mapping[str, float], success: bool | None) -> None:
        for name, value in belief.items():
            if value >= 0:
                self._log(f"{BELIEF}/{name}", "Scalars", value)
        if success is None:
            return
        self._recent.append(success)
        self._picked_up += success
        self._log(f"{SUCCESS}/of_the_last_{_RECENT}_attempts", "Scalars", np.mean(self._recent))
        self._log(f"{OBJECTS}/picked_up", "Scalars", self._picked_up)


def _is_grasp(action: Mapping[str, float]) -> bool:
    return round(action["skill.pos"]) == Skill.GRASP


def _seen_from_above(pose: FloatArray) -> FloatArray:
    """A place on a screen whose axes point right and down: forward, as the robot stood at first, is up."""
    return np.array([-pose[1], -pose[0]])
