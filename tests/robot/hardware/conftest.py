"""Emulators of the LoCoBot's parts, which test modules import by name."""

import sys
from pathlib import Path

# The SDK waits for answers in a busy loop; an emulator in the same process has to get its turn.
sys.setswitchinterval(0.0005)
sys.path.insert(0, str(Path(__file__).parent))
