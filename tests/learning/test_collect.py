"""The collection loop on the simulated robot."""

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from relmm.commands.policies import make_actor
from relmm.features import FREE_GRASPS, PRACTICE_TASK, TASK, Phase, Skill
from relmm.geometry import moved
from relmm.learning.actor import Actor
from relmm.learning.collect import Cleaner, Collector
from relmm.learning.life import Life
from relmm.policies.random.configuration_random import RelmmRandomConfig
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim


@dataclass
class ListRecorder:
    """Keeps what the loop records."""

    frames: list[tuple[dict[str, Any], dict[str, float], dict[str, Any], str]] = field(default_factory=list)
    episodes: list[list[tuple[dict[str, Any], dict[str, float], dict[str, Any], str]]] = field(default_factory=list)

    def add_frame(self, *frame: Any) -> None:
        self.frames.append(frame)

    def save_episode(self) -> None:
        self.episodes.append(self.frames)
        self.frames = []


@pytest.fixture
def robot():
    robot = LocobotSim(LocobotSimConfig(seed=5))
    robot.connect()
    yield robot
    robot.disconnect()


def collector(robot: LocobotSim, policy, **settings: Any) -> tuple[Collector, ListRecorder]:
    recorder = ListRecorder()
    defaults = {"max_steps": 12, "pseudo_reset_steps": 2, "should_stop": lambda: False}
    settings = {**defaults, **settings}
    pseudo_reset_steps = settings.pop("pseudo_reset_steps")
    life = Life(robot, [recorder], robot.seconds, **settings)
    return Collector(life, make_actor(policy), np.random.default_rng(0), pseudo_reset_steps), recorder


def test_episode_ends_at_its_step_limit(robot):
    loop, recorder = collector(robot, RelmmRandomConfig(device="cpu", grasp_probability=0.0))
    result = loop.episode()
    (episode,) = recorder.episodes
    assert result.frames == len(episode) == 12
    assert not result.success
    assert result.grasps == 0
    assert [outcome["next.truncated"] for _, _, outcome, _ in episode] == [False] * 11 + [True]
    assert not any(outcome["next.done"] for _, _, outcome, _ in episode)


def test_only_grasps_beyond_the_free_ones_count_as_steps(robot):
    loop, recorder = collector(robot, RelmmRandomConfig(device="cpu", grasp_probability=1.0, num_grasp=3))
    loop.episode()
    (episode,) = recorder.episodes
    steps = in_a_row = 0
    for _, action, _, _ in episode:
        grasp = action["skill.pos"] == Skill.GRASP
        in_a_row = in_a_row + 1 if grasp else 0
        steps += not grasp or in_a_row > FREE_GRASPS
    assert steps == 12 or episode[-1][2]["next.done"]


def test_frames_follow_one_another_in_time(robot):
    loop, recorder = collector(robot, RelmmRandomConfig(device="cpu"))
    loop.episode()
    loop.episode()
    frames = [frame for episode in recorder.episodes for frame in episode]
    times = [outcome["complementary_info.robot_time"] for _, _, outcome, _ in frames]
    assert all(later - earlier >= 0.5 - 1e-6 for earlier, later in itertools.pairwise(times))
    driven = [frame for frame in itertools.pairwise(frames) if frame[0][1]["x.vel"] > 0.1]
    for (_, action, _, _), (after, *_rest) in driven:
        assert after["x.vel"] <= action["x.vel"] + 0.05, "the next frame shows what this frame's action did"


def test_success_ends_the_episode_and_is_carried_elsewhere(robot):
    loop, recorder = collector(robot, RelmmScriptedConfig(device="cpu"), max_steps=250)
    first, second = loop.episode(), loop.episode()
    assert first.success
    assert second.success
    last = recorder.episodes[0][-1]
    assert last[1]["skill.pos"] == Skill.GRASP
    assert last[2]["next.reward"] == 1.0
    assert last[2]["next.done"]
    phases = [outcome["complementary_info.phase"] for _, _, outcome, _ in recorder.episodes[1]]
    assert phases[:15] == [Phase.PSEUDO_RESET] * 15, "2 drives, 6 turns, 1 placement, 4 turns, 2 drives"
    assert set(phases[15:]) == {Phase.LEARNING}
    rewards = [outcome["next.reward"] for episode in recorder.episodes for _, _, outcome, _ in episode]
    assert sum(rewards) == 2
    assert {task for episode in recorder.episodes for *_, task in episode} == {PRACTICE_TASK}


# --- Cleaning ------------------------------------------------------------------------------------------------
def cleaner(robot: LocobotSim, max_steps: int, to_collect: int) -> tuple[Cleaner, ListRecorder]:
    recorder, seeds = ListRecorder(), iter(range(11, 20))
    life = Life(robot, [recorder], robot.seconds, max_steps, lambda: False, to_collect)
    return Cleaner(life, make_actor(RelmmScriptedConfig(device="cpu")), lambda: robot.reset(next(seeds))), recorder


def test_cleaning_puts_what_is_picked_up_into_the_basket_and_has_no_pseudo_reset(robot):
    loop, recorder = cleaner(robot, max_steps=250, to_collect=2)
    result = loop.episode()
    assert (result.collected, result.success) == (2, True)
    assert len(robot.body.truth.in_basket()) == 2
    (episode,) = recorder.episodes
    outcomes = [outcome for _, _, outcome, _ in episode]
    assert {outcome["complementary_info.phase"] for outcome in outcomes} == {Phase.LEARNING}
    placed = [number for number, frame in enumerate(episode) if frame[1]["skill.pos"] == Skill.PLACE]
    assert [outcomes[number - 1]["next.reward"] for number in placed] == [1.0, 1.0], "what was just picked up"
    assert [outcome["next.done"] for outcome in outcomes] == [False] * (len(episode) - 1) + [True]
    assert outcomes[-1]["next.success"]
    assert {task for *_, task in episode} == {TASK}


def test_cleaning_ends_at_the_step_limit_and_goes_on_in_another_room(robot):
    loop, recorder = cleaner(robot, max_steps=6, to_collect=20)
    results = [loop.episode() for _ in range(2)]
    assert [result.steps for result in results] == [6, 6]
    assert not any(result.success for result in results)
    for episode in recorder.episodes:
        assert [outcome["next.truncated"] for _, _, outcome, _ in episode] == [False] * (len(episode) - 1) + [True]
        drives = [outcome for _, action, outcome, _ in episode if action["skill.pos"] == Skill.NAVIGATE]
        assert len(drives) == 6, "neither two attempts after a drive nor a placement cost a step"
        first = episode[0][2]
        assert (first["complementary_info.odom_x"], first["complementary_info.odom_heading"]) == (0.0, 0.0)
        assert first["complementary_info.robot_time"] < 5.0
    pictures = [episode[0][0]["front"] for episode in recorder.episodes]
    assert np.any(pictures[0] != pictures[1])


@pytest.mark.parametrize("stop_after", [1, 5])
def test_stopping_cuts_the_episode_off_after_the_frame(robot, stop_after):
    asked = []

    def stop() -> bool:
        asked.append(None)
        return len(asked) >= stop_after

    loop, recorder = collector(robot, RelmmRandomConfig(device="cpu", grasp_probability=0.0), should_stop=stop)
    result = loop.episode()
    assert result.frames == stop_after
    assert recorder.episodes[0][-1][2]["next.truncated"]


def test_what_the_policy_believed_is_recorded_where_it_acted(robot, monkeypatch):
    loop, recorder = collector(robot, RelmmScriptedConfig(device="cpu"), max_steps=250)
    assert loop.episode().success
    monkeypatch.setattr(Actor, "belief", property(lambda actor: {"grasp_mean": 0.5}))
    loop.episode()
    column = "complementary_info.grasp_mean"
    assert {outcome[column] for _, _, outcome, _ in recorder.episodes[0]} == {-1.0}
    beliefs = {(outcome["complementary_info.phase"], outcome[column]) for _, _, outcome, _ in recorder.episodes[1]}
    assert beliefs == {(Phase.PSEUDO_RESET, 0.5), (Phase.LEARNING, 0.5)}


def test_odometry_leads_to_where_the_robot_is(robot):
    loop, recorder = collector(robot, RelmmScriptedConfig(device="cpu"), max_steps=250)
    start = np.array(robot.body.truth.robot())
    loop.episode()
    loop.episode()
    assert len(recorder.episodes[0]) + len(recorder.episodes[1]) > 20
    x, y, heading = robot.body.truth.robot()
    pose = moved(start, loop._life.pose)
    assert pose[:2] == pytest.approx((x, y), abs=0.06)
    assert np.cos(pose[2] - heading) > np.cos(np.radians(8))
