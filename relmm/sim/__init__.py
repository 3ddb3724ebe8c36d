"""The simulated LoCoBot: its MuJoCo body, rooms, cameras, and the gymnasium environment for evaluation.

Importing this package registers the environment with gymnasium, as `ENV_ID`.
"""

import gymnasium as gym

from relmm.sim.gl import import_mujoco

ENV_ID = "relmm/Room-v0"

import_mujoco()  # before any module of this package does
if ENV_ID not in gym.registry:
    gym.register(ENV_ID, entry_point="relmm.sim.env:RelmmRoomEnv")
