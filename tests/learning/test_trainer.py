"""The trainer against the paper's algorithms, written out as they stand there, on a robot with scripted outcomes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scripted_world import (
    LEARN_DRIVE,
    LEARN_GRASP,
    POLICY_DRIVE,
    SAMPLED_CELL,
    FakeLearner,
    FakePolicy,
    PhaseLife,
    World,
)

from relmm.features import GRID, Phase, Skill, in_grasp_area, xy_to_cell
from relmm.learning.progress import Progress
from relmm.learning.trainer import Trainer
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

PSEUDO_RESET_STEPS = 3
TURN_ROUND_STEPS, TURN_AWAY_STEPS = 6, 4  # of a pseudo-reset, before and after the placement
DRIVE, GRASP, DROP = (("drive", Phase.LEARNING), ("grasp", Phase.LEARNING), ("place", Phase.CURRICULUM))
PRACTICE = ("grasp", Phase.CURRICULUM)


@dataclass
class Run:
    world: World
    trainer: Trainer
    progress: Progress
    policy: FakePolicy


MakeRun = Callable[..., Run]


@pytest.fixture
def make_run() -> MakeRun:
    def make(
        world: World,
        curriculum: str = "none",
        put_in_reach: Callable[[], bool] = lambda: False,
        should_stop: Callable[[], bool] = lambda: False,
        **settings: Any,
    ) -> Run:
        config = ReLMMConfig(**{"device": "cpu", "random_steps": 0, **settings})
        progress, policy = Progress(), FakePolicy(config)
        learner = FakeLearner(world, config.min_attempts_to_update)
        life = PhaseLife(world, [learner, progress], lambda: 0.0, max_steps=10**6, should_stop=should_stop)
        trainer = Trainer(
            life, policy, learner, curriculum=curriculum, pseudo_reset_steps=PSEUDO_RESET_STEPS,
            rng=np.random.default_rng(0), put_in_reach=put_in_reach, progress=progress,
        )  # fmt: skip
        return Run(world, trainer, progress, policy)

    return make


# --- The paper's algorithms ----------------------------------------------------------------------------------
def train_grasp(world: World, n: int, st: bool, phase: Phase) -> bool:
    """Algorithm 1."""
    for _ in range(n):
        r_g = world.grasp(phase)
        world.events.append(LEARN_GRASP)
        if st:
            if world.holding:
                world.place(Phase.CURRICULUM)
        elif r_g:
            return r_g
    return False


def train_grasp_auto_curr(world: World, config: ReLMMConfig) -> bool:
    """Algorithm 3; attempts count from the first success on, as in the authors' code."""
    if world.attempts_since_first_success >= config.num_max:
        return train_grasp(world, config.num_grasp, False, Phase.LEARNING)
    n_since, r_max = 0, False
    while True:
        r_g = world.grasp(Phase.CURRICULUM)
        world.events.append(LEARN_GRASP)
        n_since = 0 if r_g else n_since + 1
        r_max = r_max or r_g
        if world.attempts_since_first_success >= config.num_max:
            break
        if r_max:
            if n_since >= config.num_stop:
                break
        elif n_since >= config.num_start:
            break
        if r_g:
            world.place(Phase.CURRICULUM)
    return r_max


def pseudo_reset(world: World) -> None:
    """Section 4.3: carry it elsewhere, turn round, put it down, turn and drive away."""
    for _ in range(PSEUDO_RESET_STEPS + TURN_ROUND_STEPS):
        world.drive(Phase.PSEUDO_RESET)
    if world.holding:
        world.place(Phase.PSEUDO_RESET)
    for _ in range(TURN_AWAY_STEPS + PSEUDO_RESET_STEPS):
        world.drive(Phase.PSEUDO_RESET)


def relmm_step(world: World, config: ReLMMConfig, autonomous: bool) -> None:
    """The loop of Algorithms 2 and 4; P[grasp] is 1 while the curriculum lasts, and that of the picture after a_n."""
    practising = autonomous and world.attempts_since_first_success < config.num_max
    world.drive(Phase.LEARNING)
    r_g = False
    if practising or world.grasp_wanted:
        if autonomous:
            r_g = train_grasp_auto_curr(world, config)
        else:
            r_g = train_grasp(world, config.num_grasp, False, Phase.LEARNING)
    world.events.append(LEARN_DRIVE)
    if r_g:
        pseudo_reset(world)


# --- Normal training -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("num_grasp", [1, 2, 5])
@pytest.mark.parametrize("seed", range(5))
def test_training_is_algorithm_2(num_grasp: int, seed: int, make_run: MakeRun) -> None:
    run, paper = make_run(World(seed), num_grasp=num_grasp), World(seed)
    for _ in range(60):
        run.trainer.navigation_step()
        relmm_step(paper, run.policy.config, autonomous=False)
    assert run.world.events == paper.events
    assert run.progress.steps == 60
    assert run.policy.sampling, "it explores"


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("success", [0.05, 0.5])
def test_training_with_the_autonomous_curriculum_is_algorithm_4(seed: int, success: float, make_run: MakeRun) -> None:
    limits = {"num_start": 3, "num_stop": 6, "num_max": 50}
    run, paper = make_run(World(seed, success), "autonomous", **limits), World(seed, success)
    for _ in range(60):
        run.trainer.navigation_step()
        relmm_step(paper, run.policy.config, autonomous=True)
    assert run.world.events == paper.events
    failures_before = run.world.grasps.index(True)
    assert run.progress.practice_attempts == failures_before + 50


def test_nobody_grasps_where_p_grasp_is_0(make_run: MakeRun) -> None:
    run = make_run(World(0, wanted=0.0))
    for _ in range(5):
        run.trainer.navigation_step()
    assert run.world.events == [DRIVE, LEARN_DRIVE] * 5


def test_failed_attempts_stop_at_their_limit(make_run: MakeRun) -> None:
    run = make_run(World(0, success=0.0, wanted=1.0), num_grasp=3)
    run.trainer.navigation_step()
    assert run.world.events == [DRIVE, *[GRASP, LEARN_GRASP] * 3, LEARN_DRIVE]


def test_gate_grasps_in_proportion_to_its_probability(make_run: MakeRun) -> None:
    run = make_run(World(0, success=0.0, wanted=0.0), num_grasp=1)
    run.policy.floor_probability = 0.3
    for _ in range(600):
        run.trainer.navigation_step()
    assert run.progress.attempts / 600 == pytest.approx(0.3, abs=4 * (0.21 / 600) ** 0.5)


def test_first_steps_are_uniform_and_later_ones_the_policys(make_run: MakeRun) -> None:
    run = make_run(World(0, wanted=0.0), random_steps=20)
    for _ in range(25):
        run.trainer.navigation_step()
    assert [action == POLICY_DRIVE for action in run.world.actions] == [False] * 20 + [True] * 5
    assert len({tuple(action.values()) for action in run.world.actions}) == 21


def test_cells_are_uniform_until_the_ensemble_has_begun_to_learn(make_run: MakeRun) -> None:
    run = make_run(World(0, success=0.0, wanted=1.0), num_grasp=2, min_attempts_to_update=10)
    for _ in range(8):
        run.trainer.navigation_step()
    grasps = [action for action in run.world.actions if action["skill.pos"] == Skill.GRASP]
    cells = [xy_to_cell(action["skill_x.pos"], action["skill_y.pos"]) for action in grasps]
    assert cells[10:] == [SAMPLED_CELL] * 6
    assert len(set(cells[:10])) > 5
    assert all(0 <= cell < GRID**2 for cell in cells)


@pytest.mark.parametrize(("curriculum", "phase"), [("none", Phase.LEARNING), ("autonomous", Phase.CURRICULUM)])
def test_learner_is_told_why_it_was_grasped(curriculum: str, phase: Phase, make_run: MakeRun) -> None:
    """A frozen ensemble learns from curricula only."""
    run = make_run(World(0, success=0.0, wanted=1.0), curriculum)
    for _ in range(3):
        run.trainer.navigation_step()
    assert run.trainer.learner.phases == [phase] * 6


# --- Stationary curriculum -----------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(6))
def test_stationary_curriculum_is_algorithm_1(seed: int, make_run: MakeRun) -> None:
    """What is held at its end is carried away instead of dropped."""
    run, paper = make_run(World(seed), "stationary", num_stationary=25), World(seed)
    while run.trainer.in_stationary_curriculum:
        run.trainer.stationary_attempt()
    train_grasp(paper, 25, True, Phase.CURRICULUM)
    if paper.events[-1] == DROP:
        paper.events.pop()
        paper.holding = True
        pseudo_reset(paper)
    assert run.world.events == paper.events
    assert run.progress.practice_attempts == 25


def test_held_things_are_dropped_at_random_places_in_reach(make_run: MakeRun) -> None:
    run = make_run(World(0, success=1.0), "stationary", num_stationary=20)
    for _ in range(20):
        run.trainer.stationary_attempt()
    places = [
        (action["skill_x.pos"], action["skill_y.pos"]) for action in run.world.actions if action["skill.pos"] == 2
    ]
    assert all(in_grasp_area(x, y) for x, y in places)
    assert len(set(places)) == 20, "19 drops and the end of the curriculum"


def test_interventions_are_counted_and_seen(make_run: MakeRun) -> None:
    world, asked = World(0, success=0.0), []

    def person() -> bool:
        asked.append(world.holding)
        world.grasp_wanted = len(asked) == 3
        return world.grasp_wanted

    run, seen = make_run(world, "stationary", put_in_reach=person), []
    for _ in range(3):
        run.trainer.stationary_attempt()
        seen.append(run.policy.grasp_probability)
    assert run.progress.interventions == 1
    assert seen == [0.0, 0.0, 1.0], "the attempt looks at what the person has done"
    assert asked == [False] * 3


def test_no_curriculum_is_stationary_by_itself(make_run: MakeRun) -> None:
    for curriculum in ("none", "autonomous"):
        assert not make_run(World(0), curriculum).trainer.in_stationary_curriculum


# --- Placements that fail -------------------------------------------------------------------------------------
def test_stationary_curriculum_tries_to_drop_again_before_it_goes_on(make_run: MakeRun) -> None:
    run = make_run(World(0, success=1.0), "stationary")
    run.trainer.stationary_attempt()
    run.world.stuck = True
    for _ in range(3):
        run.trainer.stationary_attempt()
    run.world.stuck = False
    run.trainer.stationary_attempt()
    assert run.world.events == [PRACTICE, LEARN_GRASP, *[DROP] * 4, PRACTICE, LEARN_GRASP]


def test_practice_ends_where_nothing_can_be_dropped_and_the_next_step_carries_it_away(make_run: MakeRun) -> None:
    run = make_run(World(0, success=1.0), "autonomous", num_stop=5, num_max=1000)
    run.world.stuck = True
    run.trainer.navigation_step()
    paper = World(0, success=1.0, stuck=True)
    paper.events = [DRIVE, PRACTICE, LEARN_GRASP, DROP, LEARN_DRIVE]
    paper.holding = True
    pseudo_reset(paper)
    assert run.world.events == paper.events
    assert run.progress.attempts == 1
    run.world.stuck = paper.stuck = False
    before = len(run.world.events)
    run.trainer.navigation_step()
    paper.events = []
    pseudo_reset(paper)
    assert run.world.events[before:][: len(paper.events) + 1] == [*paper.events, DRIVE]


# --- Stopping ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("frames", [1, 3, 30])
def test_practice_stops_when_told(frames: int, make_run: MakeRun) -> None:
    world = World(1, success=0.5)
    run = make_run(world, "autonomous", should_stop=lambda: len(world.actions) >= frames, num_stop=1000, num_start=1000)
    run.trainer.navigation_step()
    assert len(world.actions) <= frames + 1, "at most the first frame of a pseudo-reset follows"


def test_pseudo_reset_stops_when_told(make_run: MakeRun) -> None:
    world = World(0, success=1.0, wanted=1.0)
    run = make_run(world, should_stop=lambda: len(world.actions) >= 4)
    run.trainer.navigation_step()
    assert len(world.actions) == 4
