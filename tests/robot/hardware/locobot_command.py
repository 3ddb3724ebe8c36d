"""Runs a command of relmm or LeRobot on an emulated LoCoBot, whose time may be faster than ours.

    python locobot_command.py SPEED MODULE ARGUMENT...
"""

import sys
from importlib import import_module

from relmm.robot.hardware import clock


def main() -> None:
    speed, module = sys.argv[1:3]
    clock.SPEED = float(speed)
    del sys.argv[1:3]
    import_module(module).main()


if __name__ == "__main__":
    main()
