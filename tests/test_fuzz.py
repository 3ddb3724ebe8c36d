"""Nothing that is read or parsed ends in a traceback."""

import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).parents[1] / "benchmarks" / "fuzz.py"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_damaged_files_and_command_lines_end_in_one_sentence():
    result = subprocess.run([sys.executable, FUZZ, "--cases=540", "--seed=1", "--csv="], text=True, capture_output=True)
    assert result.returncode == 0, result.stdout + result.stderr
