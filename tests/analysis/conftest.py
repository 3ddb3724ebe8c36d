import importlib.util
import sys
from pathlib import Path

import pytest

_path = Path(__file__).parent / "made.py"
_spec = importlib.util.spec_from_file_location("made", _path)
sys.modules["made"] = _module = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_module)


@pytest.fixture(scope="session")
def made():
    """The module `made`, which is no package's."""
    return _module
