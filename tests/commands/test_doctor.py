"""relmm-doctor on a healthy machine and on broken ones."""

import ctypes

import pytest

from relmm.errors import RenderingError
from relmm.sim.gl import choose_backend


def test_doctor_finds_nothing_wrong_here(run):
    result = run("relmm-doctor")
    assert result.returncode == 0, result.stdout
    assert result.stdout.count("  ok  ") == 6
    assert "FAIL" not in result.stdout


@pytest.mark.parametrize(
    "environment",
    [
        {"MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"},
        {"MUJOCO_GL": "glfw", "DISPLAY": ""},
        {"MUJOCO_GL": "nonsense"},
        {"MUJOCO_GL": "off"},
    ],
)
def test_doctor_without_opengl_says_what_to_do(run, environment):
    result = run("relmm-doctor", **environment)
    assert result.returncode == 1
    line = next(line for line in result.stdout.splitlines() if "FAIL" in line)
    assert "rendering" in line
    assert "apt-get install" in line or "unset it" in line
    assert "Traceback" not in result.stderr


def test_backend_without_any_library_is_clear(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)

    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    with pytest.raises(RenderingError, match="apt-get install libegl1"):
        choose_backend()
