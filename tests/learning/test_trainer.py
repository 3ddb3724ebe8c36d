"""The trainer against the paper's algorithms, written out as they stand there, on a robot with scripted outcomes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scripted_world import (
    CELL,
    DRIVE_AFTER,
    DRIVE_BEFORE,
    LEARN_DRIVE,
    LEARN_GRASP,
    PhaseLife,
    ScriptedLearner,
    ScriptedPolicy,
    World,
)

from relmm.features import Phase, Skill, action_dict, in_grasp_area, xy_to_cell
from relmm.learning.progress import Progress
from relmm.learning.trainer import Trainer
from relmm.policies.controller import grasp_cell
from relmm.policies.learning import LearningConfig
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig

PSEUDO_RESET_STEPS = 3
DRIVE, GRASP, DROP = (("drive", Phase.LEARNING), ("grasp", Phase.LEARNING), ("place", Phase.CURRICULUM))
PRACTICE = ("grasp", Phase.CURRICULUM)


@dataclass
class Run:
    world: World
    trainer: Trainer
    progress: Progress
    policy: ScriptedPolicy
    learner: ScriptedLearner


MakeRun = Callable[..., Run]


@pytest.fixture
def make_run() -> MakeRun:
    def make(
        world: World,
        curriculum: str = "none",
        put_in_reach: Callable[[], bool] = lambda: False,
        should_stop: Callable[[], bool] = lambda: False,
        tidy: Callable[[], int] = lambda: 0,
        tidy_every: int = 0,
        person: Callable[[], dict[str, float] | None] = lambda: None,
        **settings: Any,
    ) -> Run:
        policy = ScriptedPolicy(RelmmPaperConfig(device="cpu", **settings))
        progress, learner = Progress(), ScriptedLearner(world)
        life = PhaseLife(world, [learner, progress], lambda: 0.0, max_steps=10**6, should_stop=should_stop)
        trainer = Trainer(
            life, policy, learner, curriculum=curriculum, pseudo_reset_steps=PSEUDO_RESET_STEPS,
            rng=np.random.default_rng(0), put_in_reach=put_in_reach, progress=progress,
            tidy=tidy, tidy_every=tidy_every, person=person,
        )  # fmt: skip
        return Run(world, trainer, progress, policy, learner)

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


def train_grasp_auto_curr(world: World, config: LearningConfig) -> bool:
    """Algorithm 3 from its fifth line on; attempts count from the first success on, as in the authors' code."""
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
    """The scripted policy's."""
    for _ in range(DRIVE_BEFORE * PSEUDO_RESET_STEPS):
        world.drive(Phase.PSEUDO_RESET)
    if world.holding:
        world.place(Phase.PSEUDO_RESET)
    for _ in range(DRIVE_AFTER * PSEUDO_RESET_STEPS):
        world.drive(Phase.PSEUDO_RESET)


def relmm_step(world: World, config: LearningConfig, autonomous: bool = False) -> None:
    """The loop of Algorithms 2 and 4 from the gate on, so that a turn ends with a_n; P[grasp] is 1 while practising."""
    r_g = False
    if autonomous and world.attempts_since_first_success < config.num_max:
        r_g = train_grasp_auto_curr(world, config)
    elif world.grasp_wanted:
        r_g = train_grasp(world, config.num_grasp, False, Phase.LEARNING)
    if r_g:
        pseudo_reset(world)
    world.drive(Phase.LEARNING)
    world.events.append(LEARN_DRIVE)


# --- Normal training -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("num_grasp", [1, 2, 5])
@pytest.mark.parametrize("seed", range(5))
def test_training_is_algorithm_2(num_grasp: int, seed: int, make_run: MakeRun) -> None:
    run, paper = make_run(World(seed), num_grasp=num_grasp), World(seed)
    for _ in range(60):
        run.trainer.navigation_step()
        relmm_step(paper, run.policy.config)
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
    assert run.progress.steps == 60


def test_nobody_grasps_where_the_gate_is_shut(make_run: MakeRun) -> None:
    run = make_run(World(0, wanted=0.0))
    for _ in range(5):
        run.trainer.navigation_step()
    assert run.world.events == [DRIVE, LEARN_DRIVE] * 5


def test_failed_attempts_stop_at_their_limit_after_each_navigation_step(make_run: MakeRun) -> None:
    run = make_run(World(0, success=0.0, wanted=1.0), num_grasp=3)
    for _ in range(3):
        run.trainer.navigation_step()
    turn = [*[GRASP, LEARN_GRASP] * 3, DRIVE, LEARN_DRIVE]
    assert run.world.events == [DRIVE, LEARN_DRIVE, *turn, *turn]
    grasps = [action for action in run.world.actions if action["skill.pos"] == Skill.GRASP]
    assert {xy_to_cell(action["skill_x.pos"], action["skill_y.pos"]) for action in grasps} == {CELL}


@pytest.mark.parametrize(("curriculum", "phase"), [("none", Phase.LEARNING), ("autonomous", Phase.CURRICULUM)])
def test_learner_is_told_why_it_was_grasped(curriculum: str, phase: Phase, make_run: MakeRun) -> None:
    """A frozen ensemble learns from curricula only."""
    run = make_run(World(0, success=0.0, wanted=1.0), curriculum, num_start=2)
    for _ in range(4):
        run.trainer.navigation_step()
    assert set(run.learner.phases) == {phase}
    assert len(run.learner.phases) == run.progress.attempts >= 6


# --- What the policy sees, and what is recorded of it ----------------------------------------------------------
@pytest.mark.parametrize("curriculum", ["none", "stationary", "autonomous"])
def test_each_observation_is_observed_once_in_order(curriculum: str, make_run: MakeRun) -> None:
    run = make_run(World(1), curriculum, num_stationary=10, num_stop=4, num_max=20, put_in_reach=lambda: True)
    while run.trainer.in_stationary_curriculum:
        run.trainer.stationary_attempt()
    for _ in range(40):
        run.trainer.navigation_step()
    assert run.policy.observed == list(range(1, run.world.looks + 1))
    assert run.progress.pseudo_reset_steps > 0


@pytest.mark.parametrize("curriculum", ["none", "stationary", "autonomous"])
def test_each_frame_keeps_what_was_believed_of_its_own_picture(curriculum: str, make_run: MakeRun) -> None:
    run = make_run(World(1), curriculum, num_stationary=10, num_stop=4, num_max=20)
    while run.trainer.in_stationary_curriculum:
        run.trainer.stationary_attempt()
    for _ in range(40):
        run.trainer.navigation_step()
    outcomes = run.learner.outcomes
    assert [o["complementary_info.grasp_probability"] for o in outcomes] == [o["number"] / 1024 for o in outcomes]
    grasped = [action["skill.pos"] == Skill.GRASP for action in run.world.actions]
    means = [o["complementary_info.grasp_mean"] for o in outcomes]
    assert means == [0.75 if grasp else -1 for grasp in grasped], "of attempts only"


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
        return len(asked) == 3

    run = make_run(world, "stationary", put_in_reach=person)
    for _ in range(3):
        run.trainer.stationary_attempt()
    assert run.progress.interventions == 1
    assert asked == [False] * 3
    numbers = [outcome["number"] for outcome in run.learner.outcomes]
    assert numbers == [1, 2, 4], "the third attempt looks at what the person has done, and is recorded so"


def test_each_drive_of_a_pseudo_reset_may_teach(make_run: MakeRun) -> None:
    run = make_run(World(3, success=0.5))
    for _ in range(20):
        run.trainer.navigation_step()
    assert run.world.resets_learned == run.world.events.count(("drive", Phase.PSEUDO_RESET)) > 0


def test_room_is_tidied_now_and_then_and_looked_at_again(make_run: MakeRun) -> None:
    moved: list[int] = []  # steps at which the person was asked

    def person() -> int:
        moved.append(run.progress.steps)
        return 3 if run.progress.steps == 8 else 0

    run = make_run(World(0, wanted=0.0), tidy=person, tidy_every=4)
    for _ in range(10):
        run.trainer.navigation_step()
    assert moved == [4, 8]
    assert run.progress.interventions == 3, "each object counts"
    numbers = [outcome["number"] for outcome in run.learner.outcomes]
    assert numbers == [1, 2, 3, 4, 5, 6, 7, 8, 10, 11], "a picture is taken anew after something was moved"


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
    run = make_run(World(0, success=1.0, stuck=True), "autonomous", num_stop=5, num_max=1000)
    run.trainer.navigation_step()
    paper = World(0, success=1.0, stuck=True)
    paper.events, paper.holding = [PRACTICE, LEARN_GRASP, DROP], True
    pseudo_reset(paper)
    assert run.world.events == [*paper.events, DRIVE, LEARN_DRIVE]
    assert run.progress.attempts == 1
    run.world.stuck = paper.stuck = False
    before = len(run.world.events)
    run.trainer.navigation_step()
    paper.events = []
    pseudo_reset(paper)
    assert run.world.events[before:][: len(paper.events) + 1] == [*paper.events, PRACTICE]


# --- Stopping ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("frames", [1, 3, 30])
@pytest.mark.parametrize("curriculum", ["none", "autonomous"])
def test_a_turn_ends_soon_after_it_is_told_to_stop(frames: int, curriculum: str, make_run: MakeRun) -> None:
    world = World(1, success=0.5, wanted=1.0)
    run = make_run(world, curriculum, should_stop=lambda: len(world.actions) >= frames, num_stop=1000, num_start=1000)
    while len(world.actions) < frames:
        run.trainer.navigation_step()
    assert len(world.actions) == frames


def test_pseudo_reset_stops_when_told(make_run: MakeRun) -> None:
    world = World(0, success=1.0, wanted=1.0)
    run = make_run(world, should_stop=lambda: len(world.actions) >= 4)
    for _ in range(2):
        run.trainer.navigation_step()
    assert world.events[:3] == [DRIVE, LEARN_DRIVE, GRASP]
    assert len(world.actions) == 4


# --- A person who takes over ---------------------------------------------------------------------------------
def test_what_a_person_does_is_recorded_as_theirs_and_their_attempts_are_learned_from(make_run):
    world = World(seed=0, success=0.0, wanted=1.0)
    wishes = iter([None, action_dict(x_vel=0.1), grasp_cell(5), None])
    run = make_run(world, person=lambda: next(wishes, None), num_grasp=2)
    world.grasp_wanted = True
    run.trainer._look_again()
    looks = world.looks
    run.trainer.navigation_step()
    theirs = [("drive", Phase.TELEOPERATION), ("grasp", Phase.TELEOPERATION), LEARN_GRASP]
    own = [GRASP, *theirs, LEARN_GRASP]
    assert world.events == [GRASP, LEARN_GRASP, *own, GRASP, LEARN_GRASP, GRASP, LEARN_GRASP, DRIVE, LEARN_DRIVE], (
        "afterwards the robot has its two attempts again"
    )
    assert (run.progress.interventions, run.progress.steps, run.progress.attempts) == (1, 1, 5)
    # A look after each of 7 frames, and one more before each of the person's and when they give back.
    assert world.looks - looks == 7 + 3
    assert run.policy.observed[-1] == world.looks


def test_a_person_may_put_down_what_the_robot_holds(make_run):
    world = World(seed=0, success=1.0, wanted=1.0)
    world.grasp_wanted = True
    wishes = iter([action_dict(Skill.PLACE, x=0.4), None])
    run = make_run(world, person=lambda: next(wishes, None))
    run.trainer._look_again()
    run.trainer.navigation_step()
    assert world.events[:3] == [GRASP, ("place", Phase.TELEOPERATION), LEARN_GRASP]
    assert run.progress.objects == 1, "the success was the robot's"
    assert ("place", Phase.PSEUDO_RESET) not in world.events
