"""What faults of the Hub do to a run that uploads every few steps, and what becomes of its uploads.

    python benchmarks/hub_faults.py          # about eight minutes; writes benchmarks/results/hub_faults.csv

Each row is a training run against a Hub on this machine that begins to fail once the run has begun, in its background
uploads and in the last one. Then the Hub is well again, and the command that the run's last words name is carried out.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from csv_table import write_table

from relmm.episodes import summarize

HERE = Path(__file__).parent
STEPS = 12
TINY = (
    "--robot.type=locobot_sim --policy.device=cpu --policy.num_stationary=6 --policy.min_attempts_to_update=4 "
    "--policy.batch_size=8 --pseudo_reset_steps=2 --replay_frames=2000 --env_eval_freq=0 --save_freq=4 --max_steps=3 "
    f"--steps={STEPS} --hub.every=4 --policy.push_to_hub=true --policy.repo_id=me/policy --dataset.push_to_hub=true "
    "--dataset.repo_id=me/life"
).split()


def hub_server() -> Any:
    """The module of the tests' Hub."""
    spec = importlib.util.spec_from_file_location("hub_server", HERE.parent / "tests" / "hub_server.py")
    assert spec is not None
    assert spec.loader is not None
    sys.modules["hub_server"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


server = hub_server()
_ANY = "/repos/create|/preupload/|/commit/"
FAULTS: dict[str, Callable[[Any], None]] = {
    "none": lambda hub: None,
    "500": lambda hub: hub.faults.append(server.Fault("/repos/create", status=500)),
    "500 at the commit": lambda hub: hub.faults.append(server.Fault("/commit/", status=500)),
    "429": lambda hub: hub.faults.append(server.Fault("/repos/create", status=429)),
    "401, token revoked": lambda hub: hub.faults.append(server.Fault("/api/", status=401)),
    "404, repositories deleted": lambda hub: hub.faults.append(
        server.Fault(_ANY, status=404, headers={"X-Error-Code": "RepoNotFound"})
    ),
    "connection cut": lambda hub: hub.faults.append(server.Fault("/repos/create", cut=True)),
    "cut after the commit": lambda hub: hub.faults.append(server.Fault("/commit/", cut=True)),
    "slow, 1 s a request": lambda hub: hub.faults.append(server.Fault("", delay_s=1.0)),
    "another writer": lambda hub: hub.hooks.append(lambda repo: repo.commit(repo.files | {"note.md": os.urandom(8)})),
}


def main() -> None:
    """Print and write the table."""
    hub = server.Hub()
    threading.Thread(target=hub.serve_forever, daemon=True).start()
    rows = []
    for name, break_hub in FAULTS.items():
        hub.clear()
        with tempfile.TemporaryDirectory() as folder:
            rows.append({"fault": name, **run_with(hub, break_hub, Path(folder))})
        print(" | ".join(str(value) for value in rows[-1].values()), flush=True)
    write_table(rows, HERE / "results" / "hub_faults.csv")


def run_with(hub: Any, break_hub: Callable[[Any], None], folder: Path) -> dict[str, Any]:
    """One run against a Hub that fails, and the upload afterwards."""
    online = {"HF_ENDPOINT": hub.url, "HF_TOKEN": "hf_me", "HF_HUB_OFFLINE": "0", "HF_HOME": str(folder / "hf")}
    environment = {**os.environ, **online, "HF_HUB_DISABLE_TELEMETRY": "1", "OMP_NUM_THREADS": "1"}
    output = folder / "run"
    started = time.monotonic()
    training = subprocess.Popen(
        [sys.executable, "-m", "relmm.commands.train", *TINY, f"--output_dir={output}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    while not (output / "checkpoints" / "last").exists() and training.poll() is None:
        time.sleep(0.05)
    break_hub(hub)
    printed, errors = training.communicate()
    seconds = time.monotonic() - started
    lines = [line for line in (printed + errors).replace("\r", "\n").splitlines() if line.startswith("relmm-train: ")]
    said = lines[-1].removeprefix("relmm-train: ") if lines else "uploaded"
    episodes = summarize(output / "dataset").episodes
    step = int((output / "checkpoints" / "last").resolve().name)
    hub.faults.clear()
    hub.hooks.clear()
    later = upload_later(said, environment)
    there = hub.repos.get(("models", "me/policy"))
    return {
        "steps": f"{step}/{STEPS}",
        "episodes kept": episodes,
        "seconds": round(seconds),
        "exit status": training.returncode,
        "later upload": later,
        "on the Hub": "complete" if there and "model.safetensors" in there.files else "no",
        "last words": said.split(" Everything is saved")[0],
    }


def upload_later(said: str, environment: dict[str, str]) -> str:
    """Carry out the command that the message names."""
    if "upload it later with: " not in said:
        return "not needed"
    command = shlex.split(said.split("upload it later with: ")[1])
    result = subprocess.run(
        [sys.executable, "-m", "relmm.commands.upload", *command[1:]], capture_output=True, env=environment, check=False
    )
    return "completes" if result.returncode == 0 else result.stderr.decode()


if __name__ == "__main__":
    main()
