from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from relmm.features import FRONT, GRID, MAX_THETA_VEL, MAX_X_VEL, STATE_NAMES, Phase, Skill, action_dict
from relmm.learning.actor import to_batch
from relmm.learning.replay import Replay, Table, to_pictures
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.trail import Trail

# Episodes of drives (d), drives of pseudo-resets (r), attempts that fail (f) or do not (s), and placements (p).
Life = list[str]
SKILLS = {"d": Skill.NAVIGATE, "r": Skill.NAVIGATE, "f": Skill.GRASP, "s": Skill.GRASP, "p": Skill.PLACE}
Fill = Callable[..., Replay]


@pytest.fixture
def fill(numbered, motion_of, action_of) -> Fill:
    """A replay of a life, frame by frame."""

    def replay_of(life: Life, capacity: int = 500) -> Replay:
        replay = Replay(capacity)
        for episode in life:
            for kind in episode:
                phase = Phase.PSEUDO_RESET if kind == "r" else Phase.LEARNING
                number = replay.frames
                replay.add(numbered(number), motion_of(number), action_of(SKILLS[kind], number), kind == "s", phase)
            replay.save_episode()
        return replay

    return replay_of


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
            ends_a_pseudo_reset = each == "r" and episode[index + 1 : index + 2] not in ("", "r")
            if each == kind and outcome is not None and not ends_a_pseudo_reset:
                steps.append(Step(start + index, start + outcome[0], outcome[1]))
        start += len(episode)
    return steps


def trails_of(life: Life, motion_of) -> np.ndarray:
    """Of each frame, slowly: the drives before it, with the motions that the frames after them saw.

    They count since the beginning of the episode, and of the search after a placement or a pseudo-reset.
    """
    trails, start = [], 0
    for episode in life:
        for index in range(len(episode)):
            trail = Trail()
            ends = [k for k in range(1, index + 1) if episode[k - 1] == "p" or episode[k - 1] == "r" != episode[k]]
            for earlier in range(max(ends, default=0), index):
                if episode[earlier] in "dr":
                    trail.moved(*motion_of(start + earlier + 1))
            trails.append(trail.features())
        start += len(episode)
    return np.array(trails)


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
def test_trails_hold_the_drives_of_their_episode(seed: int, fill: Fill, motion_of) -> None:
    life = random_life(seed)
    replay = fill(life)
    assert replay.trails(np.arange(replay.frames)) == pytest.approx(trails_of(life, motion_of), abs=1e-6)


def test_next_trail_is_that_of_the_frame_to_come(numbered, action_of) -> None:
    replay = Replay(10)
    for kind in "dfdd":
        motion = (0.1 + 0.01 * replay.frames, 20.0)
        expected = replay.next_trail(motion)
        assert np.array_equal(replay.next_trail(motion), expected), "to ask changes nothing"
        replay.add(numbered(0), motion, action_of(SKILLS[kind], 0), False, Phase.LEARNING)
        assert np.array_equal(replay.trails(np.array([replay.frames - 1]))[0], expected)


def test_search_after_a_pseudo_reset_begins_with_a_new_trail(numbered, action_of) -> None:
    """As for a policy that was not asked meanwhile."""
    replay = Replay(10)
    for phase in [Phase.LEARNING, Phase.LEARNING, Phase.PSEUDO_RESET, Phase.PSEUDO_RESET, Phase.LEARNING]:
        before = replay.next_trail((0.2, 30.0))
        replay.add(numbered(0), (0.2, 30.0), action_of(Skill.NAVIGATE, 0), False, phase)
    trails = replay.trails(np.arange(5))
    assert [bool(trail.any()) for trail in trails] == [False, True, True, True, False]
    assert not before.any()
    assert replay.next_trail((0.2, 30.0)).any()


@pytest.mark.parametrize("sample", [True, False])
def test_policy_and_replay_agree_on_the_trail(sample: bool, make_policy, numbered, monkeypatch) -> None:
    """Over drives, attempts and placements, after a pseudo-reset of which the policy knows nothing."""
    policy, replay, rng = make_policy(sample=sample, grasp_threshold=0.25), Replay(200), np.random.default_rng(0)
    given: list[np.ndarray] = []
    navigate = policy.navigate
    monkeypatch.setattr(policy, "navigate", lambda *asked: (given.append(asked[1]), navigate(*asked))[1])
    drive = list(action_dict(x_vel=0.2, theta_vel=30.0).values())
    for _ in range(3):
        replay.add(numbered(0), (0.2, 30.0), drive, False, Phase.PSEUDO_RESET)
    motion, skills, next_trails = (0.2, 30.0), [], []
    for number in range(80):
        holding = skills[-1:] == [Skill.GRASP] and rng.random() < 0.2
        state = {**dict.fromkeys(STATE_NAMES, 0.0), "x.vel": motion[0], "theta.vel": motion[1], "holding.pos": holding}
        action = policy.select_action(to_batch({FRONT: numbered(number), **state}))[0].tolist()
        skills.append(round(action[2]))
        next_trails.append(replay.next_trail(motion))
        replay.add(numbered(number), motion, action, False, Phase.LEARNING)
        if skills[-1] == Skill.NAVIGATE:
            motion = float(rng.uniform(0, MAX_X_VEL)), float(rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))
    assert set(skills) == set(Skill)
    drives = np.flatnonzero(np.array(skills) == Skill.NAVIGATE)
    assert replay.trails(drives + 3) == pytest.approx(np.array(given), abs=1e-5)
    assert np.array_equal(replay.trails(drives + 3), np.array(next_trails)[drives])


def test_step_is_not_known_before_it_has_led_somewhere(numbered, action_of) -> None:
    replay = Replay(10)
    lengths = []
    for kind in "dffd":
        replay.add(numbered(0), (0.0, 0.0), action_of(SKILLS[kind], 0), False, Phase.LEARNING)
        lengths.append(len(replay.steps))
    assert lengths == [0, 0, 0, 1]


def test_last_drive_of_a_pseudo_reset_leads_to_another_memory_and_is_left_out(fill: Fill) -> None:
    replay = fill(["rrd" + "d"])
    assert rows_of(replay.pseudo_reset_steps) == [Step(0, 1, False)]
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
    driven = Trail()
    driven.moved(MAX_X_VEL, 0.5 * MAX_THETA_VEL)
    assert np.array_equal(replay.trails(np.array([0, 1])), [Trail().features(), driven.features()])
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
    assert replay.trails(after) == pytest.approx(trails_of(life, motion_of)[after], abs=1e-6)


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
