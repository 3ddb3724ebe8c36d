"""Registers everything that relmm adds to LeRobot. Importing this module is all it takes."""

import gymnasium as gym

import relmm.policies.random.configuration_random
import relmm.policies.scripted.configuration_scripted
import relmm.sim.config_locobot_sim
import relmm.sim.config_relmm_room
import relmm.teleoperator.config_locobot_scripted  # noqa: F401
from relmm.sim.config_relmm_room import ENV_ID

if ENV_ID not in gym.registry:
    gym.register(ENV_ID, entry_point="relmm.sim.env:RelmmRoomEnv")
