from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from relmm.features import GRID, MAX_THETA_VEL, MAX_X_VEL, Phase, cell_to_xy
from relmm.policies.relmm_paper.replay import Replay, Table, to_pictures

Life = list[str]
Step = tuple[int, int, bool]  # frame, the one it led to, whether to a success
Fill = Callable[..., Replay]


def random_life(seed: int) -> Life:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 15, 12)
    return ["".join(rng.choice(list("drfsp"), length, p=[0.35, 0.15, 0.3, 0.1, 0.1])) for length in lengths]


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


def steps_of(life: Life) -> list[Step]:
    """All drives but those of pseudo-resets, slowly."""
    steps, start = [], 0
    for episode in life:
        for index, each in enumerate(episode):
            outcome = step_of(episode, index)
            if each == "d" and outcome is not None:
                steps.append((start + index, start + outcome[0], outcome[1]))
        start += len(episode)
    return steps


def rows_of(replay: Replay, number_of) -> list[Step]:
    """The frames are told by their pictures."""
    steps = replay.steps.table
    before, after = ([number_of(image) for image in replay.steps.pictures[steps[name]]] for name in ("picture", "next"))
    return list(zip(before, after, steps["ended"].tolist(), strict=True))


# --- Transitions ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("life", "expected"),
    [
        (["dd"], [(0, 1, False)]),
        (["dfd"], [(0, 2, False)]),
        (["dffd"], [(0, 3, False)]),
        (["ds"], [(0, 1, True)]),
        (["dfs"], [(0, 2, True)]),
        (["dp"], [(0, 1, False)]),
        (["dsp"], [(0, 1, True)]),
        (["dsfd"], [(0, 1, True)]),
        (["d"], []),
        (["df"], [(0, 1, False)]),
        (["dff"], [(0, 1, False)]),
        (["d", "d"], []),
        (["d", "s"], []),
        (["d", "fd"], []),
        (["df", "d"], [(0, 1, False)]),
        (["fd", "dd"], [(2, 3, False)]),
        (["rrd" + "d"], [(2, 3, False)]),
        (["dr", "rs"], [(0, 1, False)]),
    ],
)
def test_drive_leads_to_the_first_success_or_the_picture_after_its_attempts(
    life, expected, fill: Fill, number_of
) -> None:
    assert rows_of(fill(life), number_of) == expected


@pytest.mark.parametrize("seed", range(30))
def test_steps_of_any_life_are_those_of_the_slow_reference(seed: int, fill: Fill, number_of) -> None:
    life = random_life(seed)
    replay = fill(life)
    assert rows_of(replay, number_of) == steps_of(life)
    frames = "".join(life)
    attempts = [index for index, kind in enumerate(frames) if kind in "fs"]
    pictures = replay.attempt_pictures[replay.attempts["picture"]]
    assert [number_of(image) for image in pictures] == attempts
    places = np.stack([replay.attempts[name] for name in "xy"], axis=1)
    assert places == pytest.approx(cell_to_xy(np.array(attempts) % GRID**2), abs=1e-6)
    assert replay.attempts["success"].tolist() == [frames[frame] == "s" for frame in attempts]
    assert replay.navigation_steps == frames.count("d")


@pytest.mark.parametrize("seed", range(5))
def test_actions_are_those_of_their_frames(seed: int, fill: Fill, number_of) -> None:
    replay = fill(random_life(seed))
    share = np.array([frame % 1000 / 1000 for frame, _, _ in rows_of(replay, number_of)])
    assert replay.steps.table["x_vel"] == pytest.approx(share * MAX_X_VEL, abs=1e-6)
    assert replay.steps.table["theta_vel"] == pytest.approx(share * MAX_THETA_VEL, abs=1e-4)


def test_step_is_not_known_before_it_has_led_somewhere(numbered, action_of) -> None:
    replay = Replay(10)
    lengths = []
    for kind in "dffd":
        replay.add(numbered(0), action_of(kind, 0), False, Phase.LEARNING)
        lengths.append(len(replay.steps))
    assert lengths == [0, 0, 0, 1]


# --- Ring ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("capacity", [1, 5, 17, 60])
@pytest.mark.parametrize("seed", range(4))
def test_the_newest_rows_of_both_kinds_are_sampled_with_their_pictures(
    capacity: int, seed: int, fill: Fill, number_of
) -> None:
    life = [*random_life(seed), "drdfs"]  # so that each table has rows
    replay, rng, frames = fill(life, capacity), np.random.default_rng(0), "".join(life)
    attempts = [index for index, kind in enumerate(frames) if kind in "fs"]
    rows = replay.sample_attempts(600, rng)
    pictures = replay.attempt_pictures[replay.attempts["picture"][rows]]
    assert {number_of(image) for image in pictures} == set(attempts[-capacity:])
    rows, steps = replay.steps.sample(600, rng), replay.steps.table
    before, after = (replay.steps.pictures[steps[name][rows]] for name in ("picture", "next"))
    seen = {(number_of(a), number_of(b), bool(c)) for a, b, c in zip(before, after, steps["ended"][rows], strict=True)}
    assert seen == set(steps_of(life)[-capacity:])


def test_neither_pseudo_resets_nor_attempts_push_out_navigation_steps(fill: Fill, number_of) -> None:
    """With room for five frames alone, thirty of other kinds would leave nothing of two steps."""
    replay = fill(["ddp", "r" * 30, "f" * 30], capacity=5)
    assert rows_of(replay, number_of) == [(0, 1, False), (1, 2, False)]


def test_picture_between_two_steps_is_kept_once(fill: Fill) -> None:
    replay = fill(["dddd"])
    assert replay.steps.table["picture"].tolist() == [0, 1, 2]
    assert replay.steps.table["next"].tolist() == [1, 2, 3]


def test_rows_are_sampled_uniformly(fill: Fill) -> None:
    replay = fill(["f" * 20])
    counts = np.bincount(replay.sample_attempts(4000, np.random.default_rng(0)), minlength=20)
    assert ((counts - 200) ** 2 / 200).sum() < 43.8  # chi-squared, 19 degrees of freedom: p = 0.001


def test_tables_grow_beyond_their_first_size() -> None:
    table = Table(number=np.int64, half=np.float32)
    for number in range(3000):
        table.append(number=number, half=number / 2)
    assert len(table) == 3000
    assert table["number"].tolist() == list(range(3000))
    assert table["half"][2999] == 1499.5


def test_pictures_are_what_the_networks_take(numbered) -> None:
    pictures = to_pictures(numbered(5)[None], torch.device("cpu"))
    assert pictures.shape == (1, 3, 100, 100)
    assert pictures.dtype == torch.uint8
    assert pictures[0, 1, 3, 4] == numbered(5)[3, 4, 1]
