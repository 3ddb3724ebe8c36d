"""Many robots on one server: recorded episodes are replayed through the real client, server and learner on loopback.

Each actor is a `Link` with a dataset of its own, which grows by episodes of a recording. The server is `relmm-serve`,
the learner `relmm-train --dataset.follow`. Prints a line for each number of actors, and appends it to a CSV.

    relmm-record --robot.type=locobot_sim --policy.type=relmm_scripted --dataset.repo_id=local/replayed \
        --dataset.root=data/replayed --dataset.num_episodes=20 --max_steps=25 --seed=0
    python benchmarks/fleet_actors.py --recording data/replayed --actors 10 100 1000 --rate 1 --seconds 60
    python benchmarks/fleet_actors.py --recording data/replayed --idle 60
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
from csv_table import append_row

from relmm.episodes.folder import EPISODE_FILES, INFO, RELMM, TASKS, DatasetFolder
from relmm.errors import FleetError
from relmm.fleet.client import Link
from relmm.fleet.mirror import Mirror
from relmm.fleet.sealed import SealedReader
from relmm.fleet.wire import open_channel
from relmm.learning.progress import read_metrics

TOKEN = "benchmark-0123456789"
_THREADS = 16
_LOOK_S = 1.0
MIB = 1 << 20


def make_template(recording: Path, target: Path) -> int:
    """A copy of a recording with a file for each episode; how many there are."""
    mirror = Mirror(target, "local/template", None)
    mirror.open(json.loads((recording / RELMM).read_text()))
    for episode in SealedReader(recording, 0).read_new():
        content = episode.content
        header = {"episode": episode.index, "offset": 0, "size": len(content)}
        mirror.put(header | {"sha256": hashlib.sha256(content).hexdigest()}, content)
    return mirror.episodes


class Robot:
    """A dataset that grows by episodes of a template.

    Args:
        root: its folder; what is there already stays.
        template: of `make_template`.
    """

    def __init__(self, root: Path, template: Path) -> None:
        self.folder, self._template = DatasetFolder(root), DatasetFolder(template)
        self._lists = self._template.files(EPISODE_FILES)
        self._info = self._template.read_json(INFO) or {}
        relmm = self._template.read_json(RELMM) or {}
        if not root.exists():
            self.folder.scratch.mkdir(parents=True)
            run = {**relmm["runs"][0], "started": root.name}
            self.folder.write_json(RELMM, relmm | {"runs": [run]})
            shutil.copyfile(template / TASKS, root / TASKS)
            self._write_info(0)

    @property
    def episodes(self) -> int:
        """How many there are by now."""
        return int((self.folder.read_json(INFO) or {})["total_episodes"])

    @property
    def is_full(self) -> bool:
        """Whether the template has no more."""
        return self.episodes == len(self._lists)

    def grow(self) -> None:
        """One more episode, in the order in which a recorder publishes its files."""
        number = self.episodes
        listed = self._lists[number]
        for name in (listed.replace("meta/episodes", "data"), listed):
            (self.folder.root / name).parent.mkdir(parents=True, exist_ok=True)
            if not (self.folder.root / name).exists():
                os.link(self._template.root / name, self.folder.root / name)
        self._write_info(number + 1)

    def _write_info(self, episodes: int) -> None:
        self.folder.write_json(INFO, self._info | {"total_episodes": episodes})


def certificate(folder: Path) -> tuple[Path, Path]:
    """A certificate for this machine, and its key."""
    pem, key = folder / "server.pem", folder / "server.key"
    command = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -days 2 -nodes -subj /CN=localhost"
    names = ["-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1", "-keyout", str(key), "-out", str(pem)]
    subprocess.run([*command.split(), *names], check=True, capture_output=True)
    return pem, key


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def start(module: str, log: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """A command of relmm as a process."""
    with log.open("ab") as file:
        command = [sys.executable, "-m", f"relmm.commands.{module}", *arguments]
        return subprocess.Popen(command, stdout=file, stderr=file, env={**os.environ, "OMP_NUM_THREADS": "1"})


def start_server(folder: Path, port: int) -> subprocess.Popen[bytes]:
    """`relmm-serve` in a folder with a certificate."""
    token = folder / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    files = [
        f"--fleet.token_file={token}",
        f"--fleet.certificate={folder}/server.pem",
        f"--fleet.key={folder}/server.key",
    ]
    data = [f"--dataset.root={folder}/robots", f"--output_dir={folder}/run", f"--fleet.listen=127.0.0.1:{port}"]
    return start("serve", folder / "serve.log", *data, *files, f"--fleet.token_file={token}")


def start_learner(folder: Path, *options: str) -> subprocess.Popen[bytes]:
    """`relmm-train` on what the server receives."""
    resume = (folder / "run" / "checkpoints" / "last").exists()
    data = [f"--dataset.follow={folder}/robots", f"--output_dir={folder}/run", f"--resume={str(resume).lower()}"]
    fixed = ["--steps=1000000", "--policy.device=cpu", "--log_freq=20", "--env_eval_freq=0"]
    return start("train", folder / "train.log", *data, *fixed, *options)


def wait_until(condition: Callable[[], object], seconds: float, what: str) -> None:
    """Wait for something that must happen."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what} did not happen within {seconds:.0f} s")
        time.sleep(0.2)


def received(folder: Path) -> int:
    """Episodes in all mirrors, by their own word."""
    infos = (DatasetFolder(path.parent.parent).read_json(INFO) for path in (folder / "robots").glob(f"*/{INFO}"))
    return sum(info["total_episodes"] for info in infos if info)


class _Drivers:
    """Threads that do for many actors what each does for itself in a recorder: grow, send, beat.

    Args:
        robots: by name.
        server: HOST:PORT.
        folder: with the certificate.
        period: s, between episodes of one actor.
    """

    def __init__(self, robots: dict[str, Robot], server: str, folder: Path, period: float) -> None:
        self.failures = self.grown = 0
        self._period, self.growing, self._stop = period, False, False
        items = list(robots.items())
        self._threads = [
            threading.Thread(target=self._drive, args=(items[n::_THREADS], server, folder)) for n in range(_THREADS)
        ]
        for thread in self._threads:
            thread.start()

    def _drive(self, robots: list[tuple[str, Robot]], server: str, folder: Path) -> None:
        links = [
            Link(open_channel(server, TOKEN, folder / "server.pem"), robot.folder.root, name, None)
            for name, robot in robots
        ]
        grow_at = [number / max(len(robots), 1) * self._period for number in range(len(robots))]
        began = 0.0
        while not self._stop:
            turn = time.monotonic()
            began = began or (turn if self.growing else 0.0)
            for index, (link, (_, robot)) in enumerate(zip(links, robots, strict=True)):
                if began and time.monotonic() - began >= grow_at[index] and not robot.is_full:
                    robot.grow()
                    self.grown += 1
                    grow_at[index] += self._period
                try:
                    link.sync()
                except FleetError:
                    self.failures += 1
                if self._stop:
                    break
            time.sleep(max(turn + _LOOK_S - time.monotonic(), 0.0))

    def stop(self) -> None:
        """End the threads."""
        self._stop = True
        for thread in self._threads:
            thread.join()


def scale(recording: Path, actors: int, rate: float, seconds: float) -> dict[str, float]:
    """One line of the table."""
    with tempfile.TemporaryDirectory(prefix="relmm-fleet-") as temporary:
        folder = Path(temporary)
        template = folder / "template"
        make_template(recording, template)
        robots = {f"me/r{n:04d}": Robot(folder / "actors" / f"r{n:04d}", template) for n in range(actors)}
        certificate(folder)
        port = free_port()
        server, learner = start_server(folder, port), start_learner(folder)
        drivers = _Drivers(robots, f"localhost:{port}", folder, 60.0 / rate)
        try:
            began = time.monotonic()
            registered = folder / "robots"
            wait_until(lambda: len(list(registered.glob(f"*/{INFO}"))) == actors, 400, "registration")
            wait_until((folder / "run" / "checkpoints" / "last").exists, 200, "the learner's start")
            registering = time.monotonic() - began
            processes = {"server": psutil.Process(server.pid), "learner": psutil.Process(learner.pid)}
            processes["actors"] = psutil.Process()
            before = {name: sum(process.cpu_times()[:2]) for name, process in processes.items()}
            peak: dict[str, int] = {}
            had, drivers.growing, began, waiting = received(folder), True, time.monotonic(), 0.0
            while time.monotonic() - began < seconds:
                time.sleep(1.0)
                for name, process in processes.items():
                    peak[name] = max(peak.get(name, 0), process.memory_info().rss)
                metrics = read_metrics(folder / "run" / "metrics.jsonl")
                waiting = max(waiting, *(line.get("episodes_waiting", 0) for line in metrics[-1:]), 0.0)
            took, grown = time.monotonic() - began, drivers.grown
            cpu = {name: sum(process.cpu_times()[:2]) - before[name] for name, process in processes.items()}
            arrived, learned = received(folder) - had, _learned(folder)
        finally:
            drivers.stop()
            for process in (learner, server):
                process.send_signal(signal.SIGTERM)
                process.wait(120)
        return {
            "actors": actors,
            "seconds": round(took, 1),
            "registering_s": round(registering, 1),
            "recorded_per_min": round(60 * grown / took, 1),
            "received_per_min": round(60 * arrived / took, 1),
            "learned_per_min": round(60 * learned / took, 1),
            "most_waiting_for_learner": waiting,
            **{f"{name}_cores": round(value / took, 3) for name, value in cpu.items()},
            **{f"{name}_MiB": round(value / MIB) for name, value in peak.items()},
            "failed_rounds": drivers.failures,
        }


def _learned(folder: Path) -> int:
    """Episodes that the newest checkpoint has learned from."""
    try:
        state = json.loads((folder / "run/checkpoints/last/training_state/relmm_state.json").read_text())
    except FileNotFoundError:  # replaced just now
        return _learned(folder)
    return int(state["counters"]["episodes"])


def idle(recording: Path, seconds: float) -> float:
    """Share of a core that a link takes while nothing is recorded."""
    with tempfile.TemporaryDirectory(prefix="relmm-fleet-") as temporary:
        folder = Path(temporary)
        certificate(folder)
        template = folder / "template"
        make_template(recording, template)
        port = free_port()
        server = start_server(folder, port)
        try:
            robot = Robot(folder / "actor", template)
            robot.grow()
            with Link(open_channel(f"localhost:{port}", TOKEN, folder / "server.pem"), robot.folder.root, "me/r", None):
                wait_until(lambda: received(folder) == 1, 100, "the first episode's arrival")
                before, began = time.process_time(), time.monotonic()
                time.sleep(seconds)
                return (time.process_time() - before) / (time.monotonic() - began)
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait(60)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, required=True)
    parser.add_argument("--actors", type=int, nargs="*", default=[])
    parser.add_argument("--rate", type=float, default=1.0, help="episodes a minute of each actor")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--idle", type=float, default=0.0, help="seconds")
    parser.add_argument("--csv", type=Path, default=Path("benchmarks/results/fleet_actors.csv"))
    arguments = parser.parse_args()
    if arguments.idle:
        print(f"idle link: {idle(arguments.recording, arguments.idle):.4f} of a core")
    for actors in arguments.actors:
        line = scale(arguments.recording, actors, arguments.rate, arguments.seconds)
        print(line, flush=True)
        append_row(line, arguments.csv)


if __name__ == "__main__":
    main()
