"""Pseudo-resets that are learned: what is remembered of them, what is rewarded, and that they learn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from relmm.features import MAX_THETA_VEL, STATE_NAMES, Phase, Skill, action_dict
from relmm.policies.controller import Row
from relmm.policies.pseudo_reset import is_turn
from relmm.policies.relmm_paper.learner import MIN_PERTURBATION_STEPS, PERTURBATIONS
from relmm.policies.relmm_paper.modeling_relmm_paper import RelmmPaperPolicy
from relmm.policies.relmm_paper.perturbation import Novelty
from relmm.policies.relmm_paper.perturbation_learning import PerturbationReplay

STATE = np.zeros(len(STATE_NAMES), np.float32)
# Frames of a life: a drive of a pseudo-reset (r), a turn (t) and a placement (p) in it; a drive (d) and a grasp (s).
ACTIONS = {
    "r": (Phase.PSEUDO_RESET, action_dict(x_vel=0.2, theta_vel=10.0)),
    "t": (Phase.PSEUDO_RESET, action_dict(theta_vel=-MAX_THETA_VEL)),
    "p": (Phase.PSEUDO_RESET, action_dict(Skill.PLACE, x=0.33)),
    "d": (Phase.LEARNING, action_dict(x_vel=0.2)),
    "s": (Phase.LEARNING, action_dict(Skill.GRASP, x=0.35)),
}


def vector(action: dict[str, float]) -> NDArray[np.float32]:
    return np.array(list(action.values()), np.float32)


@pytest.mark.parametrize(
    ("life", "before", "after"),
    [
        ("rrttpttrrrd", [(0, 1, False), (1, 2, True)], [(7, 8, False), (8, 9, False), (9, 10, True)]),
        ("rrttttrrd", [(0, 1, False), (1, 2, True)], [(6, 7, False), (7, 8, True)]),  # lost on the way
        ("rtrs rtrs", [(0, 1, True), (4, 5, True)], [(2, 3, True), (6, 7, True)]),
        ("rr rr", [(0, 1, False), (2, 3, False)], []),  # cut off twice
        ("ttdddsd", [], []),
    ],
)
def test_steps_before_and_after_the_placement_are_told_apart(life, before, after, numbered, number_of) -> None:
    replay, frame = PerturbationReplay(100), 0
    for episode in life.split():
        for kind in episode:
            phase, action = ACTIONS[kind]
            replay.add(numbered(frame), vector(action), phase)
            assert replay.newest is None or kind == "r"
            frame += 1
        replay.save_episode()
    for steps, expected in zip(replay.parts, (before, after), strict=True):
        seen = [[number_of(each) for each in steps.pictures[steps.table[name]]] for name in ("picture", "next")]
        assert list(zip(*seen, steps.table["ended"].tolist(), strict=True)) == expected


def test_pseudo_reset_drives_by_both_policies_round_the_placement(make_policy, empty) -> None:
    """One would go straight on, the other turn left."""
    policy = make_policy(perturbation="novelty")
    for perturbation, bias in zip(policy.perturbations, ([3.0, 0.0], [-0.5, 3.0]), strict=True):
        last = perturbation.drives.actor.head[-1]
        torch.nn.init.zeros_(last.weight)
        last.bias.data = torch.tensor([*bias, -9.0, -9.0])
    row = Row(np.random.default_rng(0))
    policy.observe(empty, STATE, row)
    actions = list(policy.pseudo_reset(row, 5, lambda: True))
    placed = [action["skill.pos"] for action in actions].index(Skill.PLACE)
    drives = [
        [a["theta.vel"] for a in part if not is_turn(a["x.vel"], a["theta.vel"])]
        for part in (actions[:placed], actions[placed + 1 :])
    ]
    assert [len(part) for part in drives] == [5, 5]
    assert np.abs(drives[0]).max() < 1 < 100 < min(drives[1])
    assert not list(make_policy().perturbations)


def test_new_pictures_are_rewarded_and_those_often_seen_are_not(make_config, noise_pictures) -> None:
    torch.manual_seed(0)
    novelty = Novelty(make_config(navigation_hidden=64))
    old, new = torch.full((8, 3, 100, 100), 90, dtype=torch.uint8), noise_pictures(8)
    optimizer = torch.optim.Adam(novelty.prediction.parameters(), lr=3e-3)
    for _ in range(20):
        errors = novelty.errors(old)
        optimizer.zero_grad()
        errors.mean().backward()
        optimizer.step()
    rewards = [novelty.rewards(novelty.errors(pictures)).mean().item() for pictures in (old, new)]
    assert rewards[1] > rewards[0] + 1


def test_rewards_are_the_errors_as_standard_scores_of_all_so_far(make_config, noise_pictures) -> None:
    novelty, seen = Novelty(make_config()), []
    for count in (3, 5, 2):
        errors = novelty.errors(noise_pictures(count))
        seen += errors.tolist()
    assert novelty.rewards(errors).tolist() == pytest.approx((errors.tolist() - np.mean(seen)) / np.std(seen), rel=1e-3)
    assert not any(weight.requires_grad for weight in novelty.target.parameters())


def test_each_policy_learns_after_its_own_steps_alone(make_policy, numbered, count_steps) -> None:
    policy = make_policy(perturbation="novelty", navigation_batch_size=4)
    learner = policy.make_learner(seed=0, capacity=1000)
    counts, life = count_steps(learner), "r" * (MIN_PERTURBATION_STEPS + 2) + "tptrr"
    for kind in life:
        phase, action = ACTIONS[kind]
        learner.add(numbered(0), STATE, vector(action), False, phase)
        learner.update_pseudo_reset()
    assert {name: counts[name] for name in PERTURBATIONS} == dict(zip(PERTURBATIONS, (2, 0), strict=True))
    assert counts["navigation"] == 0
    assert learner.logs["perturbation_before_novelty"] > 0


@pytest.mark.slow
def test_policy_learns_to_turn_to_what_is_new(make_policy) -> None:
    """To the left there is noise that can never be predicted, to the right always the same wall."""
    settings = {"navigation_hidden": 64, "navigation_learning_rate": 1e-3, "navigation_batch_size": 16, "gamma": 0.1}
    policy = make_policy(perturbation="novelty", initial_temperature=0.01, seed=0, **settings)
    rng, learner = np.random.default_rng(0), policy.make_learner(seed=0, capacity=1000)
    wall = np.full((100, 100, 3), 90, np.uint8)
    for _ in range(MIN_PERTURBATION_STEPS + 20):
        turn = rng.uniform(-1, 1)
        seen = rng.integers(0, 256, (100, 100, 3), np.uint8) if turn > 0 else wall
        drive = action_dict(x_vel=0.2, theta_vel=turn * 0.99 * MAX_THETA_VEL)
        for picture, action in ((wall, drive), (seen, action_dict(x_vel=0.2))):
            learner.add(picture, STATE, vector(action), False, Phase.PSEUDO_RESET)
        learner.save_episode()
        learner.perturbations.newest = 0
        learner.update_pseudo_reset()
    for _ in range(60):
        learner.perturbations.newest = 0
        learner.update_pseudo_reset()
    picture = torch.from_numpy(wall).permute(2, 0, 1)[None]
    assert policy.perturbations[0].drives.act(picture, None)[0, 1] > 0.3


def test_saved_and_loaded_the_statistics_of_novelty_are_the_same(make_policy, noise_pictures, tmp_path) -> None:
    policy = make_policy(perturbation="novelty", seed=3)
    policy.perturbations[1].novelty.errors(noise_pictures(4))
    policy.save_pretrained(tmp_path)
    loaded = RelmmPaperPolicy.from_pretrained(tmp_path)
    pairs = zip(policy.state_dict().items(), loaded.state_dict().items(), strict=True)
    assert all(name == other and torch.equal(one, two) for (name, one), (other, two) in pairs)
    assert loaded.perturbations[1].novelty.count == 4
