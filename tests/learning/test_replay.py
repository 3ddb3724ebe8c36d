from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from relmm.features import FRONT, GRID, MAX_THETA_VEL, MAX_X_VEL, Phase, action_dict
from relmm.learning.replay import Replay, Table, to_pictures
from relmm.policies.controller import grasp_cell

Life = list[str]
Fill = Callable[..., Replay]


def random_life(seed: int) -> Life:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 15, 12)
    return ["".join(rng.choice(list("drfsp"), length, p=[0.35, 0.15, 0.3, 0.1, 0.1])) for length in lengths]


@dataclass(frozen=True)
class Step:
    frame: int
    next: int
    success: bool


def step_of(episode: str, index: int) -> tuple[int, bool] | None:
    """Where the drive in frame `index` of an episode led, and whether to a success; None if nobody knows."""
    attempts = []
    for later in range(index + 1, len(episode)):
        if episode[later] not in "fs":
            following: int | None = later
            break
        attempts.append(later)
    else:
        following = None
    for attempt in attempts:
        if episode[attempt] == "s":
            return attempt, True
    if following is not None:
        return following, False
    return (attempts[0], False) if attempts else None


def steps_of(life: Life, kind: str) -> list[Step]:
    """All drives of a kind, slowly."""
    steps, start = [], 0
    for episode in life:
        for index, each in enumerate(episode):
            outcome = step_of(episode, index)
            if each == kind and outcome is not None:
                steps.append(Step(start + index, start + outcome[0], outcome[1]))
        start += len(episode)
    return steps


def rows_of(table: Table) -> list[Step]:
    return [
        Step(int(frame), int(after), bool(success))
        for frame, after, success in zip(table["frame"], table["next"], table["success"], strict=True)
    ]


# --- Transitions ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("life", "expected"),
    [
        (["dd"], [Step(0, 1, False)]),
        (["dfd"], [Step(0, 2, False)]),
        (["dffd"], [Step(0, 3, False)]),
        (["ds"], [Step(0, 1, True)]),
        (["dfs"], [Step(0, 2, True)]),
        (["dp"], [Step(0, 1, False)]),
        (["dsp"], [Step(0, 1, True)]),
        (["dsfd"], [Step(0, 1, True)]),
        (["d"], []),
        (["df"], [Step(0, 1, False)]),
        (["dff"], [Step(0, 1, False)]),
        (["d", "d"], []),
        (["d", "s"], []),
        (["d", "fd"], []),
        (["df", "d"], [Step(0, 1, False)]),
        (["fd", "dd"], [Step(2, 3, False)]),
    ],
)
def test_drive_leads_to_the_first_success_or_the_picture_after_its_attempts(life, expected, fill: Fill) -> None:
    assert rows_of(fill(life).steps) == expected


@pytest.mark.parametrize("seed", range(30))
def test_steps_of_any_life_are_those_of_the_slow_reference(seed: int, fill: Fill) -> None:
    life = random_life(seed)
    replay = fill(life)
    assert rows_of(replay.steps) == steps_of(life, "d")
    assert rows_of(replay.pseudo_reset_steps) == steps_of(life, "r")
    frames = "".join(life)
    attempts = [index for index, kind in enumerate(frames) if kind in "fs"]
    assert replay.attempts["frame"].tolist() == attempts
    assert replay.attempts["cell"].tolist() == [frame % GRID**2 for frame in attempts]
    assert replay.attempts["success"].tolist() == [frames[frame] == "s" for frame in attempts]
    assert (replay.frames, replay.episodes) == (len(frames), len(life))


@pytest.mark.parametrize("seed", range(5))
def test_actions_and_pictures_are_those_of_their_frames(seed: int, fill: Fill, number_of) -> None:
    replay = fill(random_life(seed))
    for table in (replay.steps, replay.pseudo_reset_steps):
        share = table["frame"] % 1000 / 1000
        assert table["forward"] == pytest.approx(2 * share - 1, abs=1e-6)
        assert table["turn"] == pytest.approx(share, abs=1e-6)
        for column in ("frame", "next"):
            assert [number_of(image) for image in replay.pictures(table[column])] == table[column].tolist()


@pytest.mark.parametrize("seed", range(5))
def test_motions_are_those_that_the_frames_know_of(seed: int, fill: Fill, motion_of) -> None:
    replay = fill(random_life(seed))
    frames = np.arange(replay.frames)
    assert np.allclose(replay.motions(frames), [motion_of(frame) for frame in frames.tolist()], atol=1e-5)


# --- Chains --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("length", "most"), [(1, 1), (3, 3), (5, 5), (5, 2), (3, 1)])
@pytest.mark.parametrize("seed", range(8))
def test_chains_follow_the_steps_until_a_success(length: int, most: int, seed: int, fill: Fill) -> None:
    """As one who walks from step to step."""
    replay = fill(random_life(seed))
    steps = {int(frame): row for row, frame in enumerate(replay.steps["frame"])}
    chains = replay.chains(replay.steps, np.arange(len(replay.steps)), length, most)
    for row in range(len(replay.steps)):
        walk = [row]
        while len(walk) < most and not replay.steps["success"][walk[-1]]:
            after = int(replay.steps["next"][walk[-1]])
            if after not in steps:
                break
            walk.append(steps[after])
        assert chains["lengths"][row] == len(walk)
        walk += walk[-1:] * (length - len(walk))
        assert chains["frames"][row].tolist() == [replay.steps["frame"][row], *replay.steps["next"][walk]]
        assert chains["actions"][row].tolist() == [replay.steps["forward"][row], replay.steps["turn"][row]]
        for name in ("success", "attempted"):
            assert chains[name][row].tolist() == replay.steps[name][walk].tolist()


@pytest.mark.parametrize(
    ("life", "lengths"),
    [
        (["dddd"], [3, 2, 1]),
        (["dfdd"], [2, 1]),
        (["dsd"], [1]),
        (["dpdd"], [1, 1]),
        (["ddrdd"], [2, 1, 1]),
        (["dd", "dd"], [1, 1]),
    ],
)
def test_chain_ends_where_something_else_was_done(life: Life, lengths: list[int], fill: Fill) -> None:
    replay = fill(life)
    assert replay.chains(replay.steps, np.arange(len(replay.steps)), 3, 3)["lengths"].tolist() == lengths


def test_step_is_not_known_before_it_has_led_somewhere(numbered, action_of) -> None:
    replay = Replay(10)
    lengths = []
    for kind in "dffd":
        replay.add(numbered(0), (0.0, 0.0), action_of(kind, 0), False, Phase.LEARNING)
        lengths.append(len(replay.steps))
    assert lengths == [0, 0, 0, 1]


def test_last_drive_of_a_pseudo_reset_leads_to_the_next_search(fill: Fill) -> None:
    replay = fill(["rrd" + "d"])
    assert rows_of(replay.pseudo_reset_steps) == [Step(0, 1, False), Step(1, 2, False)]
    assert rows_of(replay.steps) == [Step(2, 3, False)]


@pytest.mark.parametrize(("life", "steps"), [(["drfsd"], 2), (["dd", "rrr", "d"], 3)])
def test_navigation_steps_are_the_drives_of_learning(life: Life, steps: int, fill: Fill) -> None:
    assert fill(life).navigation_steps == steps


def test_placement_is_no_navigation_step(fill: Fill) -> None:
    assert fill(["dsp"]).navigation_steps == 1


@pytest.mark.parametrize("life", [["dfdffddpds"], ["dsprrrd", "df", "d", "dfp"], random_life(3)])
def test_replay_knows_after_which_steps_grasps_were_attempted(life: Life, fill: Fill) -> None:
    frames = "".join(life)
    ends = np.cumsum([len(episode) for episode in life]).tolist()
    replay = fill(life)
    for table in (replay.steps, replay.pseudo_reset_steps):
        after = [int(frame) + 1 for frame in table["frame"]]
        expected = [frame not in ends and frames[frame] in "fs" for frame in after]
        assert table["attempted"].tolist() == expected


def test_frames_are_taken_as_recorders_take_them(numbered) -> None:
    replay = Replay(10)
    drive = action_dict(x_vel=MAX_X_VEL, theta_vel=-MAX_THETA_VEL / 2)
    for number, (action, reward) in enumerate([(drive, 0.0), (grasp_cell(17), 1.0)]):
        outcome = {"next.reward": reward, "complementary_info.phase": int(Phase.LEARNING)}
        observation = {FRONT: numbered(number), "x.vel": number * MAX_X_VEL, "theta.vel": 0.5 * MAX_THETA_VEL}
        replay.add_frame(observation, action, outcome, "task")
    replay.save_episode()
    assert {name: values.tolist() for name, values in replay.steps.rows(np.array([0])).items()} == {
        "frame": [0], "next": [1], "forward": [1.0], "turn": [-0.5], "success": [True], "attempted": [True]
    }  # fmt: skip
    assert replay.attempts["cell"].tolist() == [17]
    assert replay.motions(np.array([0, 1])) == pytest.approx(
        np.array([[0, 0.5 * MAX_THETA_VEL], [MAX_X_VEL, 0.5 * MAX_THETA_VEL]])
    )
    assert np.array_equal(replay.pictures(np.array([1]))[0], numbered(1))


# --- Ring ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("capacity", [5, 17, 60])
@pytest.mark.parametrize("seed", range(4))
def test_what_is_sampled_still_has_its_pictures(capacity: int, seed: int, fill: Fill, number_of, motion_of) -> None:
    life = random_life(seed)
    life.append("drrdfs")  # so that each table has rows
    replay = fill(life, capacity)
    rng = np.random.default_rng(0)
    for table in (replay.attempts, replay.steps, replay.pseudo_reset_steps):
        rows = replay.sample(table, 600, rng)
        alive = {int(frame) for frame in table["frame"] if frame >= replay.frames - capacity}
        assert set(table["frame"][rows].tolist()) == alive
        frames = table["frame"][rows[:50]]
        assert [number_of(image) for image in replay.pictures(frames)] == frames.tolist()
    after = replay.steps["next"][replay.sample(replay.steps, 50, rng)]
    assert [number_of(image) for image in replay.pictures(after)] == after.tolist()
    assert np.allclose(replay.motions(after), [motion_of(frame) for frame in after.tolist()], atol=1e-5)


def test_rows_are_sampled_uniformly(fill: Fill) -> None:
    replay = fill(["f" * 20])
    counts = np.bincount(replay.sample(replay.attempts, 4000, np.random.default_rng(0)), minlength=20)
    assert ((counts - 200) ** 2 / 200).sum() < 43.8  # chi-squared, 19 degrees of freedom: p = 0.001


def test_tables_grow_beyond_their_first_size() -> None:
    table = Table(number=np.int64, half=np.float32)
    for number in range(3000):
        table.append(number=number, half=number / 2)
    assert len(table) == 3000
    assert table["number"].tolist() == list(range(3000))
    assert table.rows(np.array([0, 2999]))["half"].tolist() == [0.0, 1499.5]


def test_pictures_are_what_the_networks_take(numbered: Callable[[int], np.ndarray]) -> None:
    pictures = to_pictures(numbered(5)[None], torch.device("cpu"))
    assert pictures.shape == (1, 3, 100, 100)
    assert pictures[0, 1, 3, 4] == pytest.approx(numbered(5)[3, 4, 1] / 255)
