"""Runs a command of relmm or LeRobot on an emulated LoCoBot whose time passes only while the command sleeps.

python locobot_command.py FOLDER MODULE ARGUMENT...
"""

import sys
from importlib import import_module
from pathlib import Path

from dynamixel_sdk import port_handler
from emulated_time import SharedTime

from relmm.robot.hardware import clock

# The SDK allows an answer 34 ms. An emulator on a busy machine may take longer, above all while it draws a picture.
PATIENCE_MS = 500


def main() -> None:
    folder, module = sys.argv[1:3]
    shared = SharedTime(Path(folder) / "time")
    clock.now, clock.sleep = shared.now, shared.sleep
    port_handler.LATENCY_TIMER = PATIENCE_MS
    del sys.argv[1:3]
    import_module(module).main()


if __name__ == "__main__":
    main()
