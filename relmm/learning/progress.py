"""How far a run has come, counted from its frames, and the file of its metrics."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from relmm.episodes.follow import Episode
from relmm.features import ACTION_NAMES, Phase, Skill

_SKILL = ACTION_NAMES.index("skill.pos")


@dataclass
class Progress:
    """Counts of a run; a resumed run counts the frames of its dataset again, so none is lost.

    Attributes:
        steps: navigation steps chosen by the policy (the paper's unit; those of pseudo-resets do not count).
        practice_attempts: grasps of a curriculum.
        attempts, successes: grasps in all, and those that picked something up.
        objects: picked up outside a curriculum.
        pseudo_reset_steps: navigation steps of pseudo-resets.
        interventions: objects that a person had to put into reach, or to free, and times that one charged the robot or
            took over.
        robot_minutes: on the robot's own clock, over all its lives; the last frame is not over yet.
    """

    steps: int = 0
    practice_attempts: int = 0
    attempts: int = 0
    successes: int = 0
    objects: int = 0
    pseudo_reset_steps: int = 0
    interventions: int = 0
    robot_minutes: float = 0.0

    def __post_init__(self) -> None:
        self._times: dict[str, float] = {}  # s on each robot's clock, at its last frame

    def add_frame(
        self, observation: dict[str, Any], action: dict[str, float], outcome: dict[str, Any], task: str
    ) -> None:
        """Take one frame, as `relmm.episodes.EpisodeRecorder.add_frame` does."""
        time = outcome["complementary_info.robot_time"]
        self._add(action["skill.pos"], outcome["next.reward"] > 0, outcome["complementary_info.phase"], time)

    def read(self, episode: Episode, robot: str = "") -> None:
        """Count the frames of a recorded episode, and of which robot it is, where there are several."""
        columns = (episode.actions[:, _SKILL], episode.rewards > 0, episode.phases, episode.robot_times)
        for skill, success, phase, time in zip(*columns, strict=True):
            self._add(float(skill), bool(success), int(phase), float(time), robot)

    def _add(self, skill: float, success: bool, phase: int, time: float, robot: str = "") -> None:
        grasped, drove = round(skill) == Skill.GRASP, round(skill) == Skill.NAVIGATE
        self.steps += drove and phase == Phase.LEARNING
        self.practice_attempts += grasped and phase == Phase.CURRICULUM
        self.attempts += grasped
        self.successes += bool(success)
        self.objects += bool(success) and phase == Phase.LEARNING
        self.pseudo_reset_steps += drove and phase == Phase.PSEUDO_RESET
        # The clock begins anew with each life of the robot.
        last = self._times.get(robot, 0.0)
        self.robot_minutes += (time - last if time >= last else time) / 60
        self._times[robot] = time

    def save_episode(self) -> None:
        """Nothing to do."""

    def cut_episode(self) -> None:
        """Nothing to do."""

    def asdict(self) -> dict[str, float]:
        """By name, for logs."""
        return asdict(self)


_COUNTS = Progress().asdict().keys()
_EVALUATION, _HUGE = {"eval_collected_std", "eval_collected_each", "eval_grasp_success"}, 1e15


class Metrics:
    """A `metrics.jsonl`: one JSON object a line, on the disk when `write` returns.

    Args:
        path: of the file; appended to.
        listeners: take each line, too, after it is on the disk.

    Attributes:
        seconds: of training that the file already tells of.
    """

    def __init__(self, path: Path, listeners: Sequence[Callable[[dict[str, Any]], None]] = ()) -> None:
        self._listeners = listeners
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a", encoding="utf-8")
        self.seconds = max((line["seconds"] for line in read_metrics(path)), default=0.0)
        written = path.read_bytes()
        if written and not written.endswith(b"\n"):  # a killed run may have left half a line
            self._file.write("\n")

    def write(self, **values: Any) -> None:
        """Add a line."""
        rounded = {key: round(value, 5) if isinstance(value, float) else value for key, value in values.items()}
        self._file.write(json.dumps(rounded) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        for listener in self._listeners:
            listener(rounded)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a `metrics.jsonl`; what is no metrics, such as half a line of a killed run, is skipped."""
    lines = []
    for line in path.read_bytes().splitlines():
        try:
            values = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if _is_plausible(values):
            lines.append(values)
    return lines


def _is_plausible(line: object) -> bool:
    """Whether a line is what `Metrics.write` is given; the run's clock, curve and card are made from it."""
    if not isinstance(line, dict):
        return False
    evaluation = _EVALUATION if "eval_collected" in line else set()
    each = line.get("eval_collected_each", [])
    if not isinstance(each, list) or not {*_COUNTS, "seconds", *evaluation} <= line.keys():
        return False
    numbers = [*(value for name, value in line.items() if name != "eval_collected_each"), *each]
    return all(type(number) in (int, float) and abs(number) < _HUGE for number in numbers)
