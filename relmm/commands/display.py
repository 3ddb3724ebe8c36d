"""`--display_data`, as LeRobot's commands have it: to see what a robot does and believes while it does it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from relmm.display import LiveView
from relmm.errors import ConfigError
from relmm.geometry import camera_geometry
from relmm.learning.actor import Actor

_MEMORY = "10%"  # the viewer's share of this machine's memory, as in LeRobot


@dataclass(kw_only=True)
class DisplayOptions:
    """Options of a command that shows a robot; LeRobot's, and a file.

    Args:
        display_data: show what the robot sees, believes and does while it does it, in a viewer of rerun.
        display_ip: of a viewer that is running already; else one is started here.
        display_port: of that viewer.
        display_path: a file FILE.rrd to show it in instead, to be opened with `rerun FILE.rrd`.
    """

    display_data: bool = False
    display_ip: str | None = None
    display_port: int | None = None
    display_path: Path | None = None

    def check_display(self) -> None:
        """See that what is asked for can be shown.

        Raises:
            ConfigError: it cannot.
        """
        elsewhere = (self.display_ip, self.display_port)
        if not self.display_data:
            if self.display_path is not None or elsewhere != (None, None):
                raise ConfigError("--display_path, --display_ip and --display_port need --display_data=true: add it.")
            return
        if find_spec("rerun") is None:
            raise ConfigError("--display_data=true needs rerun: pip install 'lerobot_policy_relmm[viz]'.")
        if (self.display_ip is None) != (self.display_port is None):
            raise ConfigError("A remote viewer needs both --display_ip=ADDRESS and --display_port=PORT.")
        if self.display_path is not None:
            self._check_file(self.display_path)
        elif self.display_ip is None and not _has_screen():
            raise ConfigError(
                "There is no screen here to display on: say --display_path=FILE.rrd, or --display_ip=ADDRESS and "
                "--display_port=PORT of a viewer that runs elsewhere."
            )

    def _check_file(self, path: Path) -> None:
        if self.display_ip is not None:
            raise ConfigError("Choose one: --display_path, or --display_ip and --display_port.")
        if path.suffix != ".rrd":
            raise ConfigError(f"display_path is {path}, but the viewer opens files that end in .rrd: rename it.")
        if path.exists():
            raise ConfigError(f"{path} exists already: choose another --display_path.")


def _has_screen() -> bool:
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


@contextmanager
def live_views(
    options: DisplayOptions, command: str, camera: str, actor: Actor, learning: bool = False
) -> Iterator[list[LiveView]]:
    """The view that was asked for, none if there is none.

    Args:
        options: what was asked for.
        command: its name, which the viewer shows.
        camera: of the robot, by name.
        actor: whose beliefs are shown.
        learning: whether metrics will be shown.
    """
    if not options.display_data:
        yield []
        return
    recording = _recording(options, command)
    try:
        yield [LiveView(recording, camera_geometry(camera), actor.picture, actor.describe, learning)]
    finally:
        recording.disconnect()  # after sending what is left


def _recording(options: DisplayOptions, command: str) -> Any:
    import rerun as rr

    recording = rr.RecordingStream(command)
    try:
        if options.display_path is not None:
            options.display_path.parent.mkdir(parents=True, exist_ok=True)
            recording.save(options.display_path)
        elif options.display_ip is not None:
            recording.connect_grpc(f"rerun+http://{options.display_ip}:{options.display_port}/proxy")
        else:
            recording.spawn(memory_limit=_MEMORY)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"Nothing can be displayed ({error}): leave out --display_data, or say another place."
        ) from error
    return recording
