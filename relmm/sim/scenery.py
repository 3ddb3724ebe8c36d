"""The parts of a room as MuJoCo sees them: options, light, static geoms."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from relmm.sim.furniture import Obstacle, Rug
from relmm.sim.objects import SOLIMP, SOLREF, Color
from relmm.sim.textures import add_material

OBSTACLE_PREFIX = "obstacle_"
TIMESTEP = 0.005  # s
SKY: Color = (0.86, 0.89, 0.92)
RUG_THICKNESS, RUG_STEP = 0.0005, 0.0005  # m; thicker ones draw dotted lines along their edges
TEXTURE_SEED = 7  # a room keeps its floor and rugs, whatever the seed that scatters the objects
RUG_TEXTURE_SIZE = 256  # pixels a side
NEAR_PLANE, FAR_PLANE = 0.02, 20.0  # m


def yaw_quaternion(yaw: float) -> tuple[float, float, float, float]:
    """Of a turn by `yaw` rad about the vertical: w, x, y, z."""
    return (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))


def set_options(spec: mujoco.MjSpec) -> None:
    """Physics: a step of 5 ms, exact friction cones, sleep."""
    option = spec.option
    option.timestep = TIMESTEP
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # A gripper's hold is friction alone: the exact cone and stiff friction keep things from creeping out of it.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # What lies still costs nothing until something touches it.
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    # A state gone bad shall be found, not silently replaced by the initial one.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def set_visuals(spec: mujoco.MjSpec, extent: float) -> None:
    """Plain daylight. No shadows, antialiasing or reflections: on a CPU they cost ten times the rest of a picture."""
    spec.stat.extent = extent
    spec.stat.center = (0.0, 0.0, 0.0)
    visual = spec.visual
    visual.map.znear, visual.map.zfar = NEAR_PLANE / extent, FAR_PLANE / extent  # MuJoCo wants multiples of the extent
    visual.quality.shadowsize = visual.quality.offsamples = 0
    visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 14, 8, 1
    visual.global_.offwidth, visual.global_.offheight = 960, 720
    visual.headlight.ambient = (0.52, 0.52, 0.52)
    visual.headlight.diffuse = (0.24, 0.24, 0.24)
    visual.headlight.specular = (0.0, 0.0, 0.0)
    # What is seen over the walls; without it, black.
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=32, height=32)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_FLAT, SKY, SKY
    spec.worldbody.add_light(
        name="ceiling",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0.0, 0.0, 3.0),
        dir=(0.35, 0.20, -1.0),
        diffuse=(0.28, 0.28, 0.27),
        specular=(0.1, 0.1, 0.1),
        castshadow=False,
    )


def add_static(
    spec: mujoco.MjSpec, name: str, shape: mujoco.mjtGeom, size: tuple[float, float, float]
) -> mujoco.MjsGeom:
    """A geom that never moves, with the friction of floor and walls."""
    # The same contact stiffness as the objects', because MuJoCo averages that of the two sides.
    return spec.worldbody.add_geom(
        name=name, type=shape, size=size, friction=(1.0, 0.005, 0.0001), solref=SOLREF, solimp=SOLIMP
    )


def add_rug(spec: mujoco.MjSpec, rug: Rug, index: int) -> None:
    """Lay a rug on the floor."""
    name = f"rug_{index}"
    add_material(spec, name, rug.texture, np.random.default_rng(TEXTURE_SEED), RUG_TEXTURE_SIZE)
    geom = add_static(spec, name, mujoco.mjtGeom.mjGEOM_BOX, (rug.size[0] / 2, rug.size[1] / 2, RUG_THICKNESS / 2))
    # Without contact: a real rug gives way under wheels and balls, a rigid plate would be a kerb to both.
    geom.contype = geom.conaffinity = 0
    # Each a little higher than the one before, so that where they overlap neither flickers through the other.
    geom.pos = (rug.x, rug.y, RUG_THICKNESS / 2 + index * RUG_STEP)
    geom.quat = yaw_quaternion(rug.yaw)
    geom.material = name


def add_obstacle(spec: mujoco.MjSpec, obstacle: Obstacle, index: int) -> None:
    """Stand an obstacle on the floor, or hang it over it."""
    half_height = obstacle.height / 2
    if obstacle.shape == "box":
        shape, size = mujoco.mjtGeom.mjGEOM_BOX, (*obstacle.half_size, half_height)
    else:
        shape, size = mujoco.mjtGeom.mjGEOM_CYLINDER, (obstacle.radius, half_height, 0.0)
    geom = add_static(spec, f"{OBSTACLE_PREFIX}{index:02d}", shape, size)
    geom.pos = (obstacle.x, obstacle.y, obstacle.bottom + half_height)
    geom.quat = yaw_quaternion(obstacle.yaw)
    geom.rgba = (*obstacle.color, 1.0)
