"""How fast the simulated robot lives on one core: navigation steps and grasp attempts per second, and what they cost.

Everything a policy would wait for is timed: `send_action`, physics, and the observation with colour and depth.

    python benchmarks/sim_speed.py --steps 1000 --seed 0
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported

import argparse
import itertools
import platform
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from csv_table import write_table
from tqdm import tqdm

from relmm.episodes import EpisodeRecorder
from relmm.features import (
    BASKET_XY,
    GRID,
    MAX_THETA_VEL,
    MAX_X_VEL,
    Skill,
    action_dict,
    cell_to_xy,
    outcome_features,
)
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.renderer import Renderer

OUTPUT = Path(__file__).parent / "results" / "sim_speed.csv"
WARM_UP_STEPS = 20  # first pictures compile shaders
EPISODE_FRAMES = 100
STEPS_PER_GRASP = 5  # one attempt for so many steps


class PartTimer:
    """Adds up the seconds spent in chosen functions while it is active."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[part] += time.perf_counter() - start

        return run

    @contextmanager
    def active(self) -> Iterator[None]:
        """Time physics and rendering in here; the clock itself costs about a microsecond a call."""
        render = self._timed("rendering", Renderer.render)
        with (
            patch.object(mujoco, "mj_step", self._timed("physics", mujoco.mj_step)),
            patch.object(Renderer, "render", lambda *args: render(*args)),
        ):
            yield


@contextmanager
def one_core() -> Iterator[None]:
    """Pin this process, and those started in here, to the last core it may use."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    yield
    os.sched_setaffinity(0, cores)


def describe_machine() -> str:
    """Processor, system and versions, in one line."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = models[0] if models else platform.processor() or platform.machine()
    versions = f"Python {platform.python_version()}, MuJoCo {mujoco.__version__}, numpy {np.__version__}"
    return f"{processor}, {platform.system()}, one core; {versions}"


def random_drive(rng: np.random.Generator) -> dict[str, float]:
    """A navigation step drawn uniformly from all of them."""
    return action_dict(x_vel=rng.uniform(0, MAX_X_VEL), theta_vel=rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))


def random_grasp(rng: np.random.Generator) -> dict[str, float]:
    """A grasp in a cell drawn uniformly from all of them."""
    x, y = cell_to_xy(int(rng.integers(GRID**2)))
    return action_dict(Skill.GRASP, x=float(x), y=float(y))


def step(robot: LocobotSim, action: dict[str, float]) -> None:
    """What a control loop does: act, then observe."""
    robot.send_action(action)
    robot.get_observation()


def measure(name: str, count: int, before: Callable[[], None], act: Callable[[], None]) -> dict[str, float]:
    """Time `act`, and not the `before` that precedes each.

    Returns:
        How many a second, milliseconds each by part, and the share of the core that other processes left to this one.
    """
    timer, total, used = PartTimer(), 0.0, 0.0
    for _ in tqdm(range(count), desc=name, disable=None):
        before()
        with timer.active():
            start, start_used = time.perf_counter(), time.process_time()
            act()
            total += time.perf_counter() - start
            used += time.process_time() - start_used
    physics, rendering = timer.seconds["physics"], timer.seconds["rendering"]
    parts = {"physics_ms": physics, "rendering_ms": rendering, "rest_ms": total - physics - rendering}
    milliseconds = {key: 1000 * value / count for key, value in parts.items()}
    return {"count": count, "per_second": count / total} | milliseconds | {"core_share": min(used / total, 1.0)}


def measure_navigation(robot: LocobotSim, steps: int, rng: np.random.Generator) -> dict[str, float]:
    """Random drives, with the turns away from obstacles that they bring about."""
    with patch.object(robot.body, "drive", wraps=robot.body.drive) as drive:
        result = measure("navigation", steps, lambda: None, lambda: step(robot, random_drive(rng)))
    # A drawn turn rate never equals the limit exactly.
    turns = sum(abs(call.args[1]) == MAX_THETA_VEL for call in drive.call_args_list)
    return result | {"avoidance_turns": turns}


def measure_grasping(robot: LocobotSim, attempts: int, rng: np.random.Generator) -> dict[str, float]:
    """Random attempts, each at another place of the room; what was picked up goes into the basket untimed."""

    def move_on() -> None:
        if robot.skills.holding:
            robot.send_action(action_dict(Skill.PLACE, x=BASKET_XY[0], y=BASKET_XY[1]))
        robot.send_action(random_drive(rng))

    return measure("grasping", attempts, move_on, lambda: step(robot, random_grasp(rng))) | {"avoidance_turns": 0}


def measure_recording(robot: LocobotSim, steps: int, rng: np.random.Generator, cores: int) -> dict[str, float]:
    """The same drives, recorded; the time until the last frame is durable counts."""
    outcome = dict.fromkeys(outcome_features(), 0)
    with tempfile.TemporaryDirectory() as folder, one_core() if cores == 1 else nullcontext():
        recorder = EpisodeRecorder(
            Path(folder) / "dataset", "benchmark/speed", resume=False, depth=False, robot_type=robot.name, info={}
        )
        with recorder:
            observation, frames = robot.get_observation(), itertools.count(1)

            def act() -> None:
                nonlocal observation
                done = robot.send_action(random_drive(rng))
                recorder.add_frame(observation, done, outcome, "benchmark")
                observation = robot.get_observation()
                frame = next(frames)
                if frame % EPISODE_FRAMES == 0 or frame == steps:
                    recorder.save_episode()
                if frame == steps:
                    recorder.flush()

            return measure(f"recorded, {cores} cores", steps, lambda: None, act) | {"avoidance_turns": 0}


def run(room: str, steps: int, seed: int) -> list[dict[str, Any]]:
    """Measure navigation, then grasping, in one room."""
    robot = LocobotSim(LocobotSimConfig(room=room, seed=seed, depth=True))
    robot.connect()
    rng = np.random.default_rng(seed)
    for _ in range(WARM_UP_STEPS):
        step(robot, random_drive(rng))
    robot.reset(seed)
    rows = {}
    with one_core():
        rows["navigation"] = measure_navigation(robot, steps, np.random.default_rng(seed))
        rows["grasping"] = measure_grasping(robot, max(steps // STEPS_PER_GRASP, 1), rng)
    for cores in (2, 1):
        robot.reset(seed)
        title = f"navigation, recorded, on {cores} core{'s' * (cores - 1)}"
        rows[title] = measure_recording(robot, steps, np.random.default_rng(seed), cores)
    objects = robot.body.room.num_objects
    robot.disconnect()
    return [{"room": room, "objects": objects, "seed": seed, "task": task, **row} for task, row in rows.items()]


def show(rows: list[dict[str, Any]]) -> None:
    """Print a table."""
    columns = ("task", "count", "per_second", "physics_ms", "rendering_ms", "rest_ms", "core_share", "avoidance_turns")
    print(f"{columns[0]:48}" + "".join(f"{column:>16}" for column in columns[1:]))
    for row in rows:
        values = (f"{row[c]:.2f}" if isinstance(row[c], float) else str(row[c]) for c in columns[1:])
        print(f"{row['task']:48}" + "".join(f"{value:>16}" for value in values))


def save(rows: list[dict[str, Any]], path: Path) -> None:
    """Write the table as CSV."""
    write_table([{k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()} for row in rows], path)


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000, help="navigation steps; a fifth as many grasp attempts")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--room", default="no_obstacles")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    machine = describe_machine()
    print(machine)
    rows = run(arguments.room, arguments.steps, arguments.seed)
    show(rows)
    save([{**row, "machine": machine} for row in rows], arguments.output)


if __name__ == "__main__":
    main()
