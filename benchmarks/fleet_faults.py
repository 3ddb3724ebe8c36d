"""Kills actors, learner and server, and cuts the link, at random; counts what was lost and what was learned twice.

Each actor is a process with a dataset of its own, which grows by episodes of a recording, and the real client beside
it. All reach `relmm-serve` through a proxy that is cut now and then. At the end nobody is disturbed any more, until all
has arrived and `relmm-train` has learned from it. Then every mirror is compared with its actor's dataset, and the
updates of the optimiser with the attempts that there are: an episode learned twice, or not at all, would show.

    python benchmarks/fleet_faults.py --recording data/replayed --actors 8 --kills 20 --learner_kills 5 --cuts 20
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from fleet_actors import (
    TOKEN,
    Robot,
    certificate,
    free_port,
    make_template,
    received,
    start_learner,
    start_server,
    wait_until,
)

import relmm.plugin  # noqa: F401  (the policies, whose weights are fetched)
from relmm.episodes import read_episodes
from relmm.episodes.folder import INFO
from relmm.features import ACTION_NAMES, Skill
from relmm.fleet.client import Link
from relmm.fleet.wire import open_channel

_LEARNER = ["--policy.updates=1", "--policy.batch_size=8", "--dataset.max_waiting=1000000"]
_MIN_ATTEMPTS = 8  # policy.min_attempts_to_update


class Proxy:
    """Forwards connections to a port, unless it is cut.

    Args:
        target: the port.
    """

    def __init__(self, target: int) -> None:
        self._target, self.is_cut = target, False
        self._sockets: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """End all connections, and let no new one through."""
        self.is_cut = True
        for each in self._sockets:
            each.close()
        self._sockets = []

    def mend(self) -> None:
        """Let connections through."""
        self.is_cut = False

    def _accept(self) -> None:
        while True:
            client, _ = self._listener.accept()
            try:
                if self.is_cut:
                    raise ConnectionRefusedError
                server = socket.create_connection(("127.0.0.1", self._target))
            except OSError:
                client.close()
                continue
            self._sockets += [client, server]
            for ends in ((client, server), (server, client)):
                threading.Thread(target=_forward, args=ends, daemon=True).start()


def _forward(source: socket.socket, target: socket.socket) -> None:
    try:
        while data := source.recv(65536):
            target.sendall(data)
    except OSError:
        pass
    for each in (source, target):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)


def act(folder: Path, name: str, port: int, period: float) -> None:
    """An actor: record an episode every `period` s on average, and send it, until killed."""
    robot = Robot(folder / "actors" / name, folder / "template")
    channel = open_channel(f"localhost:{port}", TOKEN, folder / "server.pem")
    with Link(channel, robot.folder.root, f"me/{name}", folder / "actors" / f"{name}_policy"):
        while True:
            if not robot.is_full:
                robot.grow()
            time.sleep(random.uniform(0.5, 1.5) * period)


class Actors:
    """The processes of all actors."""

    def __init__(self, folder: Path, count: int, port: int, period: float) -> None:
        self._folder, self._port, self._period = folder, port, period
        self.names = [f"r{n}" for n in range(count)]
        self.processes = {name: self._start(name) for name in self.names}

    def _start(self, name: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{name}.log").open("ab") as log:
            command = [
                sys.executable,
                __file__,
                "--act",
                name,
                "--folder",
                str(self._folder),
                "--port",
                str(self._port),
                "--period",
                str(self._period),
            ]
            return subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, "OMP_NUM_THREADS": "1"})

    def restart(self, name: str) -> None:
        """Kill one, and start it again."""
        self.processes[name].kill()
        self.processes[name].wait()
        self.processes[name] = self._start(name)

    def end(self) -> None:
        """Kill them all."""
        for process in self.processes.values():
            process.kill()
            process.wait()


def step_of(link: Path) -> int | None:
    """Steps of a folder's newest checkpoint."""
    try:
        return int(os.readlink(link / "last").strip("."))
    except (OSError, ValueError):
        return None


def watch_ages(folder: Path, names: list[str], ages: list[int], ended: threading.Event) -> None:
    """How many steps the weights of each actor are behind the learner's, once a second."""
    while not ended.wait(1.0):
        newest = step_of(folder / "run" / "checkpoints")
        for name in names:
            have = step_of(folder / "actors" / f"{name}_policy")
            if newest is not None and have is not None:
                ages.append(newest - have)


def disturb(
    folder: Path, arguments: argparse.Namespace, actors: Actors, proxy: Proxy, port: int, running: dict
) -> None:
    """All kills and cuts, in a random order with random pauses."""
    rng = random.Random(arguments.seed)
    events = ["actor " + name for name in actors.names for _ in range(arguments.kills)]
    events += ["learner"] * arguments.learner_kills + ["server"] * arguments.server_kills + ["cut"] * arguments.cuts
    rng.shuffle(events)
    for number, event in enumerate(events):
        time.sleep(rng.uniform(0.2, 1.8) * arguments.pause)
        print(f"{number + 1}/{len(events)} {event}; {received(folder)} episodes received", flush=True)
        if event == "cut":
            proxy.cut()
            time.sleep(rng.uniform(0.1, 3.0))
            proxy.mend()
        elif event.startswith("actor "):
            actors.restart(event.split()[1])
        else:
            running[event].kill()
            running[event].wait()
            running[event] = start_server(folder, port) if event == "server" else start_learner(folder, *_LEARNER)


def attempts_of(root: Path) -> int:
    """Grasp attempts in a dataset."""
    skill = ACTION_NAMES.index("skill.pos")
    return sum(int((episode.actions[:, skill].round() == Skill.GRASP).sum()) for episode in read_episodes(root))


def differences(ours: Path, theirs: Path) -> int:
    """Episodes that are not the same in both, or only in one."""
    pairs = list(zip(read_episodes(ours), read_episodes(theirs), strict=False))
    other = sum(not all(np.array_equal(getattr(a, key), getattr(b, key)) for key in vars(a)) for a, b in pairs)
    counts = [int(json.loads((root / INFO).read_text())["total_episodes"]) for root in (ours, theirs)]
    return other + max(counts) - len(pairs)


def judge(folder: Path, names: list[str]) -> dict[str, int]:
    """What has come of it all."""
    from safetensors.numpy import load_file

    actors, mirrors = folder / "actors", folder / "robots"
    state = folder / "run/checkpoints/last/training_state"
    learned = json.loads((state / "relmm_state.json").read_text())
    attempts = sum(attempts_of(mirrors / f"me--{name}") for name in names)
    files = list(state.rglob("*.safetensors"))
    steps = [int(v.max()) for file in files for key, v in load_file(file).items() if key.endswith("step")]
    return {
        "recorded": sum(Robot(actors / name, folder / "template").episodes for name in names),
        "received": received(folder),
        "other": sum(differences(actors / name, mirrors / f"me--{name}") for name in names),
        "learned": int(learned["counters"]["episodes"]),
        "sources": len(learned["sources"]),
        "attempts": attempts,
        "updates_expected": attempts - (_MIN_ATTEMPTS - 1),
        "updates": max(steps, default=0),
    }


def main() -> None:
    """Disturb, wait, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--actors", type=int, default=8)
    parser.add_argument("--kills", type=int, default=20, help="of each actor")
    parser.add_argument("--learner_kills", type=int, default=5)
    parser.add_argument("--server_kills", type=int, default=5)
    parser.add_argument("--cuts", type=int, default=20)
    parser.add_argument("--pause", type=float, default=10.0, help="s between disturbances, on average")
    parser.add_argument("--period", type=float, default=10.0, help="s between episodes of an actor, on average")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--act")
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--port", type=int)
    arguments = parser.parse_args()
    if arguments.act:
        act(arguments.folder, arguments.act, arguments.port, arguments.period)
        return
    with tempfile.TemporaryDirectory(prefix="relmm-faults-") as temporary:
        folder = Path(temporary)
        make_template(arguments.recording, folder / "template")
        certificate(folder)
        ages: list[int] = []
        port, ended = free_port(), threading.Event()
        proxy = Proxy(port)
        running = {"server": start_server(folder, port), "learner": start_learner(folder, *_LEARNER)}
        wait_until((folder / "run" / "checkpoints" / "last").exists, 200, "the learner's start")
        actors = Actors(folder, arguments.actors, proxy.port, arguments.period)
        try:
            watcher = threading.Thread(target=watch_ages, args=(folder, actors.names, ages, ended))
            watcher.start()
            began = time.monotonic()
            disturb(folder, arguments, actors, proxy, port, running)
            robots = [Robot(folder / "actors" / name, folder / "template") for name in actors.names]
            wait_until(lambda: all(robot.is_full for robot in robots), 600, "the end of the recording")
            total = sum(robot.episodes for robot in robots)
            wait_until(lambda: received(folder) == total, 300, "the arrival of all episodes")
            counters = folder / "run/checkpoints/last/training_state/relmm_state.json"
            wait_until(lambda: json.loads(counters.read_text())["counters"]["episodes"] == total, 300, "learning")
            ended.set()
            watcher.join()
        finally:
            ended.set()
            actors.end()
            for process in running.values():
                process.send_signal(signal.SIGTERM)
                process.wait(120)
        result = judge(folder, actors.names)
        bound = {"oldest_weights_steps": max(ages), "mean_weights_steps": round(float(np.mean(ages)), 1)}
        print(json.dumps({"seconds": round(time.monotonic() - began), **result, **bound}, indent=4))


if __name__ == "__main__":
    main()
