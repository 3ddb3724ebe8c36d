"""Which checkpoints a learner keeps whose robots act by the newest one."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from relmm.commands.train_stream import _PASSING, _Checkpoints


@pytest.fixture
def run(tmp_path):
    """What is asked of a run, which writes empty checkpoints."""
    tracked: list[int] = []
    run = SimpleNamespace(
        config=SimpleNamespace(checkpoints=tmp_path, save_freq=100), progress=SimpleNamespace(steps=0), tracked=tracked
    )

    def save(episodes, runs, cursors, passing) -> Path:
        folder = tmp_path / f"{run.progress.steps:06d}"
        folder.mkdir(exist_ok=True)
        if not passing:
            tracked.append(run.progress.steps)
        return folder

    run.save = save
    return run


def save_at(run, steps) -> list[int]:
    """Save at these steps, as after a resume; what there is in the end."""
    checkpoints = _Checkpoints(run, SimpleNamespace(all=[]))
    for step in steps:
        run.progress.steps = step
        checkpoints.save()
    return sorted(int(path.name) for path in run.config.checkpoints.iterdir())


def test_the_first_of_each_period_is_kept_and_the_newest(run):
    assert save_at(run, range(0, 260, 10)) == [0, 100, 200, *range(220, 260, 10)]
    assert run.tracked == [0, 100, 200]


def test_one_step_saved_twice_counts_once(run):
    assert save_at(run, [0, *[10] * 9, *[20] * 9]) == [0, 10, 20]


def test_a_resumed_run_removes_those_of_before_too(run):
    for first in range(0, 300, 30):
        there = save_at(run, range(first, first + 30, 10))
    assert there == [0, 100, 200, 260, 270, 280, 290]
    assert len(there) == 3 + _PASSING
    assert run.tracked == [0, 100, 200]
