"""Runs a command of relmm or LeRobot on an emulated LoCoBot whose time passes only while the command sleeps.

python locobot_command.py FOLDER MODULE ARGUMENT...
"""

import sys
from importlib import import_module
from pathlib import Path

from emulated_time import SharedTime, live_in


def main() -> None:
    folder, module = sys.argv[1:3]
    live_in(SharedTime(Path(folder) / "time"))
    del sys.argv[1:3]
    import_module(module).main()


if __name__ == "__main__":
    main()
