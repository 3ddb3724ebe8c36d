"""Pictures of a MuJoCo scene: colour and depth in one pass."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.sim.gl import choose_backend, gl_context, not_working

_MAX_GEOMS = 2000


class Renderer:
    """Renders one camera of one model.

    Args:
        model: the compiled model.
        camera: a fixed camera's name, or a free camera.
        size: width and height in pixels, within the model's offscreen buffer.
    """

    def __init__(self, model: mujoco.MjModel, camera: str | mujoco.MjvCamera, size: tuple[int, int]) -> None:
        self._gl = gl_context()
        self._gl.make_current()
        self._model = model
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except mujoco.FatalError as error:  # the context was made, but without a display it is not usable
            raise not_working(choose_backend(), error) from error
        self._scene = mujoco.MjvScene(model, _MAX_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
            self._scene.flags[flag] = False
        self._options = mujoco.MjvOption()
        self._camera = _fixed_camera(model, camera) if isinstance(camera, str) else camera
        self._viewport = mujoco.MjrRect(0, 0, *size)
        self._rgb = np.zeros((size[1], size[0], 3), np.uint8)
        self._depth = np.zeros((size[1], size[0]), np.float32)

    def render(self, data: mujoco.MjData) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour, uint8 (height, width, 3), and distance along the optical axis in m, (height, width)."""
        self._gl.make_current()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)  # renderers share the context
        mujoco.mjv_updateScene(
            self._model, data, self._options, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._depth, self._viewport, self._context)
        # OpenGL's rows start at the bottom, and its depth buffer is a hyperbola between the clipping planes.
        near = self._model.vis.map.znear * self._model.stat.extent
        far = self._model.vis.map.zfar * self._model.stat.extent
        depth = near / (1 - self._depth[::-1] * (1 - near / far))
        return self._rgb[::-1].copy(), depth

    def close(self) -> None:
        """Free the textures and buffers; the OpenGL context stays for other renderers."""
        self._gl.make_current()
        self._context.free()


def _fixed_camera(model: mujoco.MjModel, name: str) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    camera.fixedcamid = model.camera(name).id
    return camera


def overview_camera(size: tuple[float, float]) -> mujoco.MjvCamera:
    """A free camera that sees a whole room of `size` (m) from above and behind."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = 0.0, 0.0, 0.0
    camera.distance = 1.35 * max(size)
    camera.azimuth, camera.elevation = 90.0, -58.0
    return camera
