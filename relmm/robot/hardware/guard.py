"""A process of its own that holds the base's serial port, and stops the base when the robot's program falls silent.

A Kobuki keeps driving at its last command, and a program that was killed or stopped (`kill -9`, Ctrl-Z, a debugger, no
memory left) sends none. So bytes go through this process: it passes them on both ways, and when no frame has come for
`SILENCE_S`, or the program is gone, it sends the frame that stops the base. It opens the port again when the cable
comes back, and the first thing that it sends there is a stop.

    python -m relmm.robot.hardware.guard PORT SOCKET_NUMBER
"""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import sys
import time
from typing import TYPE_CHECKING

from relmm.robot.hardware.kobuki_protocol import BAUD_RATE, PERIOD_S, STOP

if TYPE_CHECKING:
    import serial

SILENCE_S = 0.25  # of the program, which sends every 0.02 s
_REOPEN_S = 0.2  # between attempts to open the port
_LAST_STOPS = 5  # when the program has gone; one could be lost
_CHUNK = 4096


class Guard:
    """Passes bytes on between a socket and a serial port.

    Args:
        port: the base's device.
        program: a socket whose other end is the robot's program.
    """

    def __init__(self, port: str, program: socket.socket) -> None:
        self._port, self._program = port, program
        self._serial: serial.Serial | None = None
        self._opened = self._heard = self._stopped = float("-inf")  # when that happened last, s

    def run(self) -> None:
        """Until the program has gone."""
        self._program.setblocking(False)
        try:
            while self._pass_on():
                self._stop_in_silence()
        finally:
            for _ in range(_LAST_STOPS):
                self._write(STOP)
                time.sleep(PERIOD_S)

    def _pass_on(self) -> bool:
        """Wait for bytes and hand them over; whether the program is still there."""
        self._open()
        ready, _, _ = select.select([self._program, *self._open_ports()], [], [], PERIOD_S)
        for source in ready:
            if source is self._program:
                data = self._program.recv(_CHUNK)
                if not data:
                    return False
                self._heard = time.monotonic()
                self._write(data)
            else:
                self._read()
        return True

    def _stop_in_silence(self) -> None:
        now = time.monotonic()
        silent = now - self._heard > SILENCE_S
        if silent and now - self._stopped > PERIOD_S:
            self._write(STOP)
            self._stopped = now

    def _open_ports(self) -> list[serial.Serial]:
        return [] if self._serial is None else [self._serial]

    def _open(self) -> None:
        import serial

        if self._serial is not None or time.monotonic() - self._opened < _REOPEN_S:
            return
        self._opened = time.monotonic()
        with contextlib.suppress(OSError):  # the cable is not back yet; the program sees that nothing comes
            # A write that waits for a base that does not read must not keep the guard from its work.
            self._serial = serial.Serial(self._port, BAUD_RATE, timeout=0, write_timeout=PERIOD_S, exclusive=True)
            self._write(STOP)

    def _read(self) -> None:
        if self._serial is None:  # lost while the program's bytes were passed on
            return
        try:
            data = self._serial.read(_CHUNK)
        except OSError:  # serial.SerialException is one
            self._lose_port()
            return
        with contextlib.suppress(BlockingIOError):  # a stopped program does not read: what it misses is stale anyway
            self._program.send(data)

    def _write(self, data: bytes) -> None:
        import serial

        if self._serial is None:
            return
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            return  # the next frame comes soon
        except OSError:
            self._lose_port()

    def _lose_port(self) -> None:
        assert self._serial is not None
        with contextlib.suppress(OSError):
            self._serial.close()
        self._serial = None


def main() -> None:
    """Entry point of the process."""
    # The program decides when it ends: Ctrl-C and a lost terminal are for it, and its end is seen at the socket.
    for ignored in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGTSTP):
        signal.signal(ignored, signal.SIG_IGN)
    port, number = sys.argv[1:]
    # A program that was killed while bytes were under way resets the socket instead of closing it.
    with socket.socket(fileno=int(number)) as program, contextlib.suppress(ConnectionError):
        Guard(port, program).run()


if __name__ == "__main__":
    main()
