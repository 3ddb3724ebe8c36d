"""Registers everything that relmm adds to LeRobot and gymnasium. Importing this module is all it takes."""

import relmm.policies.random.configuration_random
import relmm.policies.relmm.configuration_relmm
import relmm.policies.relmm_paper.configuration_relmm_paper
import relmm.policies.relmm_single.configuration_relmm_single
import relmm.policies.scripted.configuration_scripted
import relmm.robot.hardware.config_locobot
import relmm.sim.config_locobot_sim
import relmm.sim.config_relmm_room
import relmm.teleoperator.config_locobot_keyboard
import relmm.teleoperator.config_locobot_scripted  # noqa: F401
