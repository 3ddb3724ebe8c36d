"""The vocabulary: names, units and ranges of actions and observations, and the grid of grasp cells.

Every part of relmm takes these names from here: robots, environments, policies and datasets.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]


class Skill(IntEnum):
    """What one action does (`skill.pos`)."""

    NAVIGATE = 0
    GRASP = 1
    PLACE = 2


class Phase(IntEnum):
    """Who acted in a frame, and why (`complementary_info.phase`)."""

    CURRICULUM = 0
    LEARNING = 1
    PSEUDO_RESET = 2
    EVALUATION = 3
    TELEOPERATION = 4


# What a robot is told to do (`task`): in evaluations and `--mode=clean`, and while it practises.
TASK = "Pick up all objects and put them into the basket."
PRACTICE_TASK = "Pick up an object and put it down somewhere else."

# --- Actions -------------------------------------------------------------------------------------------------
# Every name ends in `.vel` or `.pos`, because LeRobot's rollout drops all others.
ACTION_NAMES = ("x.vel", "theta.vel", "skill.pos", "skill_x.pos", "skill_y.pos")

# A navigation step: a drive pulse, then a brake. The authors' robot drives at most 0.106 m forward and turns at
# most 27 degrees in one; the two limits below are those displacements divided by the length of the pulse.
NAVIGATION_STEP_S = 0.5
DRIVE_PULSE_S = 0.24
MAX_X_VEL = 0.44  # m/s, never backwards
MAX_THETA_VEL = 112.5  # deg/s, positive = left
FPS = int(1 / NAVIGATION_STEP_S)  # frames per second of datasets and videos

FREE_GRASPS = 2  # attempts after a navigation step that cost no step of an episode (N_grasp of the paper)

# Where a carried object is dropped to count as collected: the middle of the basket on the robot's right-hand side.
BASKET_XY = (0.025, -0.1075)  # m, robot frame

# --- Observations --------------------------------------------------------------------------------------------
JOINT_NAMES = ("waist.pos", "shoulder.pos", "elbow.pos", "wrist_angle.pos", "wrist_rotate.pos")  # degrees
# How far the wheels moved the base during the last skill, in its frame at the beginning, divided by `DRIVE_PULSE_S`;
# turns away from obstacles are part of it. m/s forward, m/s left, deg/s (positive = left).
MOTION_NAMES = ("x.vel", "y.vel", "theta.vel")
# The nearest thing higher than the objects in each direction, m from the robot's centre; right to left.
SCAN_BEARINGS = tuple(range(-60, 61, 3))  # degrees, positive = left; each is the middle of a sector of 3 degrees
SCAN_NAMES = tuple(f"scan_{index:02d}.pos" for index in range(len(SCAN_BEARINGS)))
SCAN_RANGE = 3.0  # m; the value of a sector in which no such thing is seen
# The gripper's opening in metres; holding 0 or 1; bumper: the sum of 1 (right), 2 (centre) and 4 (left), as the Kobuki
# reports it.
STATE_NAMES = (*MOTION_NAMES, *JOINT_NAMES, "gripper.pos", "holding.pos", "bumper.pos", *SCAN_NAMES)
MOTION = slice(0, len(MOTION_NAMES))  # where these stand in `observation.state`
SCAN = slice(len(STATE_NAMES) - len(SCAN_NAMES), len(STATE_NAMES))

FRONT = "front"
FRONT_DEPTH = "front_depth"
IMAGE_SIZE = 100  # pixels, square
IMAGE_KEY = f"observation.images.{FRONT}"
DEPTH_KEY = f"observation.images.{FRONT_DEPTH}"
STATE_KEY = "observation.state"

# --- Grasp cells ---------------------------------------------------------------------------------------------
GRID = 15  # cells a side; the flat index is GRID * ix + iy
GRASP_X = (0.30, 0.4667)  # m, robot frame, forward
GRASP_Y = (-0.08, 0.08)  # m, robot frame, left


def cell_to_xy(cell: int | FloatArray) -> FloatArray:
    """Centre of a grasp cell.

    Args:
        cell: flat index or indices, 0..GRID**2 - 1, any shape.

    Returns:
        Metres in the robot frame, the shape of `cell` with (x, y) appended.
    """
    ix, iy = np.divmod(np.asarray(cell), GRID)
    x = GRASP_X[0] + (ix + 0.5) * (GRASP_X[1] - GRASP_X[0]) / GRID
    y = GRASP_Y[0] + (iy + 0.5) * (GRASP_Y[1] - GRASP_Y[0]) / GRID
    return np.stack([x, y], axis=-1)


def xy_to_cell(x: float, y: float) -> int:
    """Flat index of the grasp cell that holds a point; points outside go to the nearest cell."""
    ix = int((x - GRASP_X[0]) / (GRASP_X[1] - GRASP_X[0]) * GRID)
    iy = int((y - GRASP_Y[0]) / (GRASP_Y[1] - GRASP_Y[0]) * GRID)
    return GRID * min(max(ix, 0), GRID - 1) + min(max(iy, 0), GRID - 1)


def in_grasp_area(x: float, y: float) -> bool:
    """Whether a point of the floor (m, robot frame) lies in the rectangle of the grasp cells."""
    return GRASP_X[0] <= x <= GRASP_X[1] and GRASP_Y[0] <= y <= GRASP_Y[1]


def action_dict(
    skill: Skill = Skill.NAVIGATE, x_vel: float = 0.0, theta_vel: float = 0.0, x: float = 0.0, y: float = 0.0
) -> dict[str, float]:
    """An action by name: a navigation step by default; `x` and `y` (m) say where to grasp or place."""
    return dict(zip(ACTION_NAMES, (x_vel, theta_vel, float(skill), x, y), strict=True))


def carried_out(commands: FloatArray, holding: NDArray[np.bool_]) -> FloatArray:
    """What a robot does on commands: speeds within its limits, the nearest skill, and nothing where it refuses.

    It refuses to grasp with a full gripper and to place with an empty one: it stands still for a navigation step.

    Args:
        commands: by `ACTION_NAMES`, (n, 5); not changed.
        holding: whether it holds something before each, (n,).

    Returns:
        The actions, (n, 5).
    """
    low, high = [0.0, -MAX_THETA_VEL, min(Skill)], [MAX_X_VEL, MAX_THETA_VEL, max(Skill)]
    actions = commands.copy()
    actions[:, :3] = np.clip(actions[:, :3], low, high)
    skills = actions[:, 2] = actions[:, 2].round()
    refused = ((skills == Skill.GRASP) & holding) | ((skills == Skill.PLACE) & ~holding)
    actions[refused] = list(action_dict().values())
    return actions


# --- Datasets ------------------------------------------------------------------------------------------------
# What a policy believed when it decided (`complementary_info.<name>`), -1 where it has no opinion: P[grasp], and mean
# and standard deviation over the ensemble at the attempted cell.
BELIEF = ("grasp_probability", "grasp_mean", "grasp_std")
# Where the robot was at the frame's start, by its own wheels since the run began: m, m, degrees (not wrapped).
ODOMETRY = ("odom_x", "odom_y", "odom_heading")
# Navigation steps that the learner had seen when it saved the weights that acted; -1 where they were nobody else's.
WEIGHTS_STEP = "complementary_info.weights_step"


def outcome_features() -> dict[str, dict[str, Any]]:
    """The columns a recorded frame has beyond LeRobot's observation and action."""
    scalar = {"shape": (1,), "names": None}
    return {
        "next.reward": {"dtype": "float32", **scalar},  # 1.0 when this frame's grasp picked something up
        "next.done": {"dtype": "bool", **scalar},  # the episode ended with what it was for
        "next.truncated": {"dtype": "bool", **scalar},  # the episode ended at its step limit
        "next.success": {"dtype": "bool", **scalar},
        "complementary_info.phase": {"dtype": "int64", **scalar},  # a `Phase`
        **{f"complementary_info.{name}": {"dtype": "float32", **scalar} for name in (*BELIEF, *ODOMETRY)},
        "complementary_info.robot_time": {"dtype": "float32", **scalar},  # s on the robot's clock, at the frame's start
        WEIGHTS_STEP: {"dtype": "int64", **scalar},
    }


# What the columns of a recorded frame mean, with their units.
DATASET_COLUMNS = {
    "action": "what was really done: `x.vel` m/s forward, `theta.vel` deg/s (positive = left), both during the drive "
    "pulse of a navigation step; `skill.pos` 0 navigate, 1 grasp, 2 place; `skill_x.pos`, `skill_y.pos` m in the "
    "robot's frame (x forward, y left): where to grasp or place",
    STATE_KEY: "`x.vel`, `y.vel` m/s and `theta.vel` deg/s: how far the wheels moved the base forward, left and round "
    f"(positive = left) during the last skill, seen from where it began, divided by {DRIVE_PULSE_S} s; arm joints in "
    "degrees; `gripper.pos` m between the finger pads; `holding.pos` 0 or 1; `bumper.pos` the sum of 1 right, "
    "2 centre, 4 left; `scan_*.pos` m from the robot's centre to the nearest thing higher than the objects, every "
    f"{SCAN_BEARINGS[1] - SCAN_BEARINGS[0]} degrees from {SCAN_BEARINGS[0]} to {SCAN_BEARINGS[-1]} (positive = left), "
    f"{SCAN_RANGE} where none is seen",
    IMAGE_KEY: "the robot's camera before the skill, RGB, PNG, lossless",
    DEPTH_KEY: "millimetres along the optical axis",
    "next.reward": "1.0 where this frame's grasp picked something up, as the robot's own sensors judge it",
    "next.done": "the episode ended with that success, or with all objects in the basket (`--mode=clean`)",
    "next.truncated": "the episode ended at its step limit, or because the recording was stopped",
    "next.success": "as `next.done`",
    "complementary_info.phase": "who acted, see above",
    "complementary_info.grasp_probability": "P[grasp] before the action where the policy estimates it, else -1",
    "complementary_info.grasp_mean": "the ensemble's mean success at the attempted cell before the attempt, else -1",
    "complementary_info.grasp_std": "its standard deviation over the members, else -1",
    "complementary_info.odom_x": "m, where the robot was when the frame began, by its wheels since the run began "
    "(`--mode=clean`: the episode)",
    "complementary_info.odom_y": "m, likewise",
    "complementary_info.odom_heading": "degrees, likewise, not wrapped, positive = left",
    "complementary_info.robot_time": "s on the robot's clock when the frame began",
    WEIGHTS_STEP: "navigation steps that the learner had seen when it saved the weights that acted, to tell their age; "
    "-1 where the robot learns itself, or its policy does not change",
    "timestamp": f"s, the frame's number in its episode divided by {FPS}",
}


def dataset_features(depth: bool = False, camera: dict[str, Any] | None = None) -> dict[str, dict[str, Any]]:
    """The whole schema of a relmm dataset, as `LeRobotDataset.create(features=...)` takes it.

    Args:
        depth: also store the depth picture (millimetres).
        camera: what is known about the camera that takes the pictures, see `relmm.geometry.camera_info`. It becomes
            part of the pictures' `info`, which LeRobot's own tools keep when they edit a dataset, and compare when they
            merge several.
    """
    size, names = IMAGE_SIZE, ["height", "width", "channels"]
    known = {} if camera is None else {"camera": camera}
    features: dict[str, dict[str, Any]] = {
        "action": {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": list(ACTION_NAMES)},
        STATE_KEY: {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)},
        IMAGE_KEY: {
            "dtype": "image",
            "shape": (size, size, 3),
            "names": names,
            "info": {"is_depth_map": False, **known},
        },
    }
    if depth:
        features[DEPTH_KEY] = {
            "dtype": "image",
            "shape": (size, size, 1),
            "names": names,
            "info": {"is_depth_map": True, **known},
        }
    return features | outcome_features()
