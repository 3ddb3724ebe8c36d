"""LeRobot's own commands, unmodified, on relmm's robot, policies, environment and datasets: each run once.

As a user would run them:

    python benchmarks/stock_commands.py

Everything is written to a temporary folder, which also stands in for the user's Hugging Face home.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tqdm import tqdm

OUTPUT = Path(__file__).parent / "results" / "stock_commands.csv"
ROBOT = "--robot.type=locobot_sim --robot.room=no_obstacles"
QUIET = "--play_sounds=false"
DATASET = "--dataset.repo_id=me/room --dataset.root=room"
TRAINING = (
    f"--policy.type=relmm --policy.device=cpu --policy.push_to_hub=false {DATASET} --batch_size=4 --num_workers=0 "
    "--log_freq=1 --seed=0"
)
EVALUATION = "--env.type=relmm_room --env.navigation_steps=5 --eval.n_episodes=1 --eval.batch_size=1"
EDIT = "lerobot-edit-dataset --repo_id=me/room --root=room"
TRAINED = "trained/checkpoints/last/pretrained_model"

# What is shown, the command, and a file that it must have written.
COMMANDS = [
    ("records a dataset to work with", f"relmm-record {ROBOT} --policy.type=relmm_scripted {DATASET} "
     "--dataset.num_episodes=4 --max_steps=20", "room/meta/info.json"),
    ("records by the scripted teleoperator", f"lerobot-record {ROBOT} --teleop.type=locobot_scripted "
     "--dataset.repo_id=me/teleop --dataset.root=teleop --dataset.single_task=Clean --dataset.num_episodes=1 "
     "--dataset.fps=2 --dataset.episode_time_s=3 --dataset.reset_time_s=0 --dataset.video=false "
     f"--dataset.push_to_hub=false {QUIET}", "teleop/meta/info.json"),
    ("replays an episode", f"lerobot-replay {ROBOT} {DATASET} --dataset.episode=0 {QUIET}", None),
    ("trains, and evaluates in the room", f"lerobot-train {TRAINING} --steps=2 --save_freq=2 --env_eval_freq=2 "
     f"{EVALUATION} --output_dir=trained", f"{TRAINED}/model.safetensors"),
    ("resumes", f"lerobot-train --config_path={TRAINED}/train_config.json --resume=true --steps=4",
     "trained/checkpoints/000004/pretrained_model/model.safetensors"),
    ("trains in two processes", "accelerate launch --multi_gpu --num_processes=2 --module "
     f"lerobot.scripts.lerobot_train {TRAINING} --steps=2 --save_freq=2 --env_eval_freq=0 --output_dir=parallel",
     "parallel/checkpoints/last/pretrained_model/model.safetensors"),
    ("trains from a stream", f"lerobot-train {TRAINING} --dataset.streaming=true --num_workers=1 --steps=2 "
     "--save_freq=2 --env_eval_freq=0 --output_dir=streamed", "streamed/checkpoints/last/pretrained_model"),
    ("evaluates", f"lerobot-eval --policy.path={TRAINED} {EVALUATION} --output_dir=evaluated",
     "evaluated/eval_info.json"),
    ("drives the robot by a policy", f"lerobot-rollout {ROBOT} --policy.path={TRAINED} --strategy.type=base "
     "--duration=3 --fps=2 --task=Clean", None),
    ("deletes an episode", f"{EDIT} --new_repo_id=me/shorter --new_root=shorter --operation.type=delete_episodes "
     "--operation.episode_indices=[1]", "shorter/meta/info.json"),
    ("splits", f'{EDIT} --new_root=halves --operation.type=split --operation.splits={{"a":[0,1],"b":[2,3]}}', None),
    ("merges", "lerobot-edit-dataset --new_repo_id=me/both --new_root=both --operation.type=merge "
     "--operation.repo_ids=['me/room','me/shorter'] --operation.roots=['room','shorter']", "both/meta/info.json"),
    ("draws an episode", "lerobot-dataset-viz --repo-id=me/room --root=room --episode-index=0 --save=1 "
     "--output-dir=drawn --num-workers=0", "drawn"),
]  # fmt: skip


def run(command: str, wanted: str | None, folder: Path) -> tuple[str, float]:
    """Run a command in a folder: "ok" or its last line of output, and seconds."""
    words = shlex.split(command)
    words[0] = str(Path(sys.executable).parent / words[0])
    environment = {**os.environ, "HF_HOME": str(folder / "hf"), "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    environment["ACCELERATE_USE_CPU"] = "true"  # or it would take two processes for two GPUs
    start = time.monotonic()
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    seconds = time.monotonic() - start
    if done.returncode != 0:
        return (done.stderr.strip().splitlines() or ["no output"])[-1], seconds
    if wanted is not None and not (folder / wanted).exists():
        return f"did not write {wanted}", seconds
    return "ok", seconds


def main() -> None:
    """Run them all, print a table and write the CSV; the exit status says whether all is well."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    output: Path = parser.parse_args().output
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for shown, command, wanted in tqdm(COMMANDS, unit="command"):
            result, seconds = run(command, wanted, Path(temporary))
            rows.append((shlex.split(command)[0], shown, f"{seconds:.0f}", result))
            tqdm.write(f"{rows[-1][0]:22}{shown:40}{seconds:5.0f} s  {result}")
    output.parent.mkdir(parents=True, exist_ok=True)
    with output.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("command", "what", "seconds", "result"), *rows])
    sys.exit(any(row[-1] != "ok" for row in rows))


if __name__ == "__main__":
    main()
