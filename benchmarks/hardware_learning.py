"""What a LoCoBot learns through its whole hardware stack, beside the simulated one at the same number of attempts.

`relmm-train --robot.type=locobot` drives the emulated robot of the tests: its Kobuki and its motors speak the real
protocols on pseudo-terminals, its camera is a fake of librealsense, and the simulator moves it all. No person helps.
The checkpoint of `locobot_sim` that has made about as many attempts is the other row. `relmm-eval` evaluates both
in the same ten simulated rooms.

    python benchmarks/hardware_learning.py --seeds 0 --steps 100

Finished trainings and evaluations are kept in --output and not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from csv_table import write_table

from relmm.learning.progress import read_metrics

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "hardware_learning.csv"
sys.path.insert(0, str(HERE.parent / "tests" / "robot" / "hardware"))
from emulated_process import Emulated  # noqa: E402

ROOM, CAMERA, EPISODES, EVERY = "no_obstacles", "d435", 10, 10
SIMULATED = ["--robot.type=locobot_sim", f"--robot.room={ROOM}", f"--robot.camera={CAMERA}"]
TRAIN = [f"--policy.camera={CAMERA}", "--curriculum.type=autonomous", "--env_eval_freq=0"]
TRAIN += [f"--log_freq={EVERY}", f"--save_freq={EVERY}"]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


def train(robot: str, seed: int, steps: int, output: Path) -> Path:
    """Train on `locobot` or `locobot_sim`, unless that was done before; the folder of the run."""
    folder = output / robot / f"seed_{seed}"
    options = [*TRAIN, f"--steps={steps}", f"--seed={seed}", f"--output_dir={folder}"]
    finished = folder / "checkpoints" / f"{steps:06d}"
    if finished.exists():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / f"seed_{seed}.log").open("w") as log:
        if robot == "locobot_sim":
            command = [sys.executable, "-m", "relmm.commands.train", *SIMULATED, *options]
            subprocess.run(command, check=True, stdout=log, stderr=log, env=ENVIRONMENT)
            return folder
        with tempfile.TemporaryDirectory() as devices, Emulated(Path(devices) / "robot", ROOM, seed=seed) as emulated:
            command = emulated.command("relmm.commands.train", *options)
            environment = {**emulated.environment, "OMP_NUM_THREADS": "1"}
            subprocess.run(command, check=True, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=environment)
    return folder


def evaluate(folder: Path, step: int) -> tuple[float, float]:
    """Mean and standard deviation of what a checkpoint collects, shares."""
    output = folder / f"eval_{step:06d}"
    if not output.exists():
        policy = folder / "checkpoints" / f"{step:06d}" / "pretrained_model"
        words = [f"--policy.path={policy}", f"--env.room={ROOM}", f"--env.camera={CAMERA}", "--seed=0"]
        words += [f"--eval.n_episodes={EPISODES}", "--eval.n_videos=0", f"--output_dir={output}"]
        subprocess.run([sys.executable, "-m", "relmm.commands.evaluate", *words], check=True, env=ENVIRONMENT)
    overall = json.loads((output / "eval_info.json").read_text())["overall"]
    return overall["mean_share_collected"], overall["std_share_collected"]


def measure(robot: str, seed: int, line: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A row of the table: the checkpoint that a line of the metrics tells of."""
    collected, spread = evaluate(folder, line["steps"])
    return {
        "robot": robot,
        "seed": seed,
        "steps": line["steps"],
        "attempts": line["attempts"],
        "successes": line["successes"],
        "robot_minutes": round(line["robot_minutes"], 1),
        "seconds": line["seconds"],
        "collected": collected,
        "collected_std": spread,
    }


def lines_of_checkpoints(folder: Path) -> list[dict[str, Any]]:
    """Lines of the metrics that there is a checkpoint of."""
    lines = read_metrics(folder / "metrics.jsonl")
    return [line for line in lines if (folder / "checkpoints" / f"{line['steps']:06d}").exists()]


def compare(seed: int, steps: int, output: Path) -> list[dict[str, Any]]:
    """Both rows of a seed."""
    hardware, simulated = (train(robot, seed, steps, output) for robot in ("locobot", "locobot_sim"))
    last = lines_of_checkpoints(hardware)[-1]
    nearest = min(lines_of_checkpoints(simulated), key=lambda line: abs(line["attempts"] - last["attempts"]))
    return [measure("locobot", seed, last, hardware), measure("locobot_sim", seed, nearest, simulated)]


def main() -> None:
    """Train, evaluate, print the table, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=100, help="navigation steps of each training")
    parser.add_argument("--output", type=Path, default=Path("outputs/hardware_learning"))
    arguments = parser.parse_args()
    rows = [row for seed in arguments.seeds for row in compare(seed, arguments.steps, arguments.output)]
    for row in rows:
        print(", ".join(f"{key} {value}" for key, value in row.items()))
    write_table(rows, RESULTS)


if __name__ == "__main__":
    main()
