"""Runs console scripts in forks of a process that has imported LeRobot, PyTorch and MuJoCo once.

Each run is a process of its own, with its own arguments, folder and output, as a user's is; only the seconds of imports
are saved. Reads a request a line from stdin, as JSON, and answers each with the exit status.
"""

import importlib
import json
import os
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

PRELOAD = (
    "relmm.plugin",
    "relmm.commands.analyze",
    "relmm.commands.evaluate",
    "relmm.commands.record",
    "relmm.commands.train",
    "relmm.commands.upload",
    "relmm.sim.locobot_sim",
    "relmm.policies.relmm.modeling_relmm",
    "lerobot.datasets.lerobot_dataset",
    "lerobot.policies.factory",
    "lerobot.scripts.lerobot_record",
    "lerobot.scripts.lerobot_train",
)


def wait_for(child: int, seconds: float) -> int:
    """The exit status of a child; it is killed when the time is over."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, 9)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def become(request: dict) -> None:
    """In the child: what a new process would have."""
    os.setsid()
    os.chdir(request["cwd"])
    os.environ.update(request["environment"])
    for number, path, flags in (
        (0, os.devnull, os.O_RDONLY),
        (1, request["stdout"], os.O_WRONLY | os.O_CREAT),
        (2, request["stderr"], os.O_WRONLY | os.O_CREAT),
    ):
        opened = os.open(path, flags)
        os.dup2(opened, number)
        os.close(opened)
    sys.argv = [request["command"], *request["arguments"]]


def serve() -> str:
    """Answer requests; in a child, the name of the script that it is to run."""
    for name in PRELOAD:
        importlib.import_module(name)
    threads = {Path(f"/proc/self/task/{thread}/comm").read_text().strip() for thread in os.listdir("/proc/self/task")}
    assert len(threads - {"jemalloc_bg_thd"}) == 1, f"threads do not survive a fork, and there are {threads}"
    for line in sys.stdin.buffer:
        request = json.loads(line)
        child = os.fork()
        if not child:
            become(request)
            return request["command"]
        print(wait_for(child, request["seconds"]), flush=True)
    sys.exit()


if __name__ == "__main__":  # processes that a script spawns import this file, too
    (script,) = entry_points(group="console_scripts", name=serve())
    sys.exit(script.load()())
