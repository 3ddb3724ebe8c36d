"""A robot whose learner is elsewhere does what one that learns itself does, but for the updates."""

import numpy as np
import pytest
from scripted_world import LEARN_DRIVE, LEARN_GRASP, PhaseLife, ScriptedLearner, ScriptedPolicy, World

from relmm.learning.collect import Practice, Watcher
from relmm.learning.progress import Progress
from relmm.learning.trainer import Trainer
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig

SETTINGS = {"num_stationary": 7, "num_start": 2, "num_stop": 3, "num_max": 30}
EPISODES = 25


def lived(seed, curriculum, make):
    """What happened to a robot in some episodes, and what is made to live there."""
    world, stop = World(seed), [False]
    progress, watcher = Progress(), Watcher()
    policy = ScriptedPolicy(RelmmPaperConfig(device="cpu", **SETTINGS))
    life = PhaseLife(world, [watcher, progress], lambda: 0.0, max_steps=6, should_stop=lambda: stop[0])
    options = {"curriculum": curriculum, "pseudo_reset_steps": 3, "rng": np.random.default_rng(0)}
    options |= {"put_in_reach": lambda: False, "progress": progress}
    return world, life, make(life, policy, world, watcher, options)


@pytest.mark.parametrize("curriculum", ["stationary", "autonomous", "none"])
@pytest.mark.parametrize("seed", range(3))
def test_it_does_what_the_trainer_does(curriculum, seed):
    world, life, practice = lived(
        seed, curriculum, lambda life, policy, world, watcher, options: Practice(life, policy, watcher, **options)
    )
    results = [practice.episode() for _ in range(EPISODES)]
    assert life.episodes_ended >= EPISODES
    assert all(result.frames for result in results)
    other, other_life, trainer = lived(
        seed,
        curriculum,
        lambda life, policy, world, watcher, options: Trainer(life, policy, ScriptedLearner(world), **options),
    )
    while len(other.actions) < len(world.actions):
        trainer.stationary_attempt() if trainer.in_stationary_curriculum else trainer.navigation_step()
    assert other.actions == world.actions
    assert [event for event in other.events if event not in (LEARN_GRASP, LEARN_DRIVE)] == world.events
    assert other_life.episodes_ended == life.episodes_ended
    if curriculum == "stationary":
        assert sum(event == ("grasp", 0) for event in world.events) == SETTINGS["num_stationary"]


def test_a_stopped_robot_does_not_wait_for_an_episode_to_end():
    world, life, practice = lived(
        0, "none", lambda life, policy, world, watcher, options: Practice(life, policy, watcher, **options)
    )
    life.should_stop = lambda: True
    assert practice.episode().frames == 0
    assert not world.actions
