"""The simulated LoCoBot: its MuJoCo body, rooms, cameras, and the gymnasium environment for evaluation."""

from relmm.sim.gl import import_mujoco

import_mujoco()  # before any module of this package does
