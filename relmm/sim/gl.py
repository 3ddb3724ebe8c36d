"""One OpenGL context for this process, without a display and without a GPU where there is none."""

from __future__ import annotations

import atexit
import ctypes
import importlib
import os
import sys
import warnings
from functools import lru_cache
from typing import Any

from relmm.errors import RenderingError

_LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
_ADVICE = (
    "install a driver for rendering without a display with: apt-get install libegl1 libgl1-mesa-dri "
    "(or libosmesa6, and set MUJOCO_GL=osmesa)"
)


def choose_backend() -> str:
    """The OpenGL backend that MuJoCo should use here: `MUJOCO_GL` if it is set, else what this machine has.

    Raises:
        RenderingError: nothing usable is installed.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted in ("disable", "disabled", "off", "false", "0"):
        raise RenderingError(f"MUJOCO_GL={wanted} turns rendering off, but the robot needs its camera: unset it.")
    if wanted or not sys.platform.startswith("linux"):
        return wanted or "glfw"
    for backend, library in _LIBRARIES.items():
        try:
            ctypes.CDLL(library)
            return backend
        except OSError:
            continue
    raise RenderingError(f"No OpenGL library was found for rendering without a display: {_ADVICE}.")


def import_mujoco() -> None:
    """Import MuJoCo without the OpenGL backend of `MUJOCO_GL`: `gl_context` loads that, and can say why it fails."""
    wanted = os.environ.pop("MUJOCO_GL", None)
    importlib.import_module("mujoco")
    if wanted is not None:
        os.environ["MUJOCO_GL"] = wanted


def not_working(backend: str, error: Exception) -> RenderingError:
    """The error that says why rendering fails and what to install."""
    reason = str(error).split(". ")[0].split("\n")[0] or type(error).__name__
    return RenderingError(f"OpenGL through {backend} does not work here ({reason}): {_ADVICE}.")


@lru_cache(maxsize=1)
def gl_context() -> Any:
    """The process's OpenGL context, made at the first call. `make_current()` it before use.

    Raises:
        RenderingError: OpenGL does not work here.
    """
    # Mesa's software rasteriser: for pictures of 100x100 handing tiles to other threads costs more than it saves.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    backend = choose_backend()
    try:
        with warnings.catch_warnings(action="ignore"):  # glfw warns, and goes on, where there is no display
            context = importlib.import_module(f"mujoco.{backend}").GLContext(64, 64)
            context.make_current()
    except Exception as error:  # drivers raise anything, from ImportError to bare OpenGL errors
        raise not_working(backend, error) from error
    atexit.register(context.free)
    return context
