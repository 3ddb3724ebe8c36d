"""The process that guards the base, at the moment when everything happens at once."""

from __future__ import annotations

import socket

import pytest

pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")

from pty_link import Cable

from relmm.robot.hardware.guard import Guard
from relmm.robot.hardware.kobuki_protocol import STOP


def test_guard_outlives_a_cable_that_is_pulled_out_while_it_passes_bytes_on(tmp_path):
    cable = Cable(tmp_path / "kobuki")
    program, other = socket.socketpair()
    with program, other:
        guard = Guard(str(cable.path), other)
        guard._open()
        assert guard._serial is not None
        program.send(STOP)
        cable.unplug()
        assert guard._pass_on(), "both ends had something to tell"
        assert guard._serial is None
