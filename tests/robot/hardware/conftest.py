"""Emulators of the LoCoBot's parts, which test modules import by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
