"""An emulated LoCoBot in a process of its own, and commands that drive it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
FAKES = HERE / "fakes"
_FPS = "10"  # of its camera
_END_S = 10.0


class Emulated:
    """Lives until it is closed.

    Args:
        folder: of its devices; made here.
        room: where it is put.
        num_objects: in the room.
        seed: of the room.
        speed: of its time against ours; 0 to let it pass only while the driving program sleeps.
        faults: how it differs from the drawing, see `emulated_locobot.Faults`.

    Attributes:
        folder: as given.
        options: `--robot.*`, of commands that drive it.
        environment: of such commands.
    """

    def __init__(
        self,
        folder: Path,
        room: str = "no_obstacles",
        num_objects: int = 20,
        seed: int = 0,
        speed: float = 0.0,
        **faults: float,
    ) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        words = [sys.executable, str(HERE / "emulated_locobot.py"), str(folder), room]
        words += [str(num_objects), str(seed), str(speed), json.dumps(faults)]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._expect("ready")
        self.options = [
            "--robot.type=locobot",
            f"--robot.base_port={folder}/kobuki",
            f"--robot.arm_port={folder}/dxl",
            f"--robot.calibration_dir={folder}/calibration",
        ]
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(FAKES), str(HERE), os.environ.get("PYTHONPATH", "")]),
            "RELMM_FAKE_REALSENSE": str(folder / "camera"),
            "RELMM_FAKE_REALSENSE_FPS": _FPS,
        }

    def order(self, what: str, *numbers: float) -> list[float]:
        """Let a person do something, see `emulated_locobot.Person`; what they see."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{what} {' '.join(map(str, numbers))}\n")
        self._process.stdin.flush()
        return self._expect("done")

    def command(self, module: str, *arguments: str) -> list[str]:
        """The words of a command of relmm or LeRobot that drives it, in its time."""
        return [
            *(sys.executable, str(HERE / "locobot_command.py"), str(self.folder), module),
            *self.options,
            *arguments,
        ]

    def run(
        self, module: str, *arguments: str, said: str = "", timeout: float = 550
    ) -> subprocess.CompletedProcess[str]:
        """Run such a command to its end; `said` is what a person types."""
        return subprocess.run(
            self.command(module, *arguments),
            env=self.environment,
            input=said,
            capture_output=True,
            text=True,
            timeout=timeout,
        )

    def _expect(self, word: str) -> list[float]:
        assert self._process.stdout is not None
        said, *numbers = self._process.stdout.readline().split() or [""]
        assert said == word, f"the emulated LoCoBot says {said!r}"
        return [float(number) for number in numbers]

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Emulated:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
