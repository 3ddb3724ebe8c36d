import numpy as np
import pytest
import torch

from relmm.commands.policies import make_actor
from relmm.commands.thoughts import describe_action, grasp_map
from relmm.features import GRID, Skill, action_dict
from relmm.policies.controller import grasp_cell
from relmm.policies.random.configuration_random import RelmmRandomConfig
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.grasping import Estimate


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (action_dict(x_vel=0.4, theta_vel=-30.0), "0.40 m/s, -30 deg/s"),
        (action_dict(Skill.GRASP, x=0.41, y=0.05), "grasp at 0.41, +0.05 m"),
        (action_dict(Skill.PLACE), "into the basket"),
    ],
)
def test_actions_are_described(action, words):
    assert describe_action(action) == words


def test_map_shows_far_cells_above_left_ones_on_the_left_and_the_chosen_one_in_white():
    actor = make_actor(ReLMMConfig(device="cpu", num_members=1, grasp_channels=4, navigation_hidden=8))
    mean = torch.zeros(1, GRID**2)
    far_left, near_right = GRID * (GRID - 1) + GRID - 1, 0
    mean[0, far_left] = 1.0
    actor.policy.estimate = Estimate(mean, torch.zeros_like(mean))
    picture = grasp_map(actor, grasp_cell(near_right))
    brightness = picture.astype(int).sum(axis=-1)
    assert brightness[0, 0] > 400, "far and left"
    assert (picture[GRID - 1, GRID - 1] == 255).all(), "chosen, near and right"
    assert np.count_nonzero(brightness > 100) == 2


def test_policy_without_an_ensemble_has_no_map():
    assert grasp_map(make_actor(RelmmRandomConfig(device="cpu")), action_dict()) is None
