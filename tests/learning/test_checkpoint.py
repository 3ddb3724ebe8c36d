"""Checkpoints: what is saved comes back, and a crash at any moment leaves the last one whole."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from relmm.commands.policies import make_actor
from relmm.errors import ConfigError
from relmm.features import Phase
from relmm.learning import checkpoint as module
from relmm.learning.checkpoint import (
    check_same_networks,
    last_checkpoint,
    load_training_state,
    pretrained_model,
    save_checkpoint,
)
from relmm.learning.learner import Learner
from relmm.learning.replay import Replay
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

SMALL = {
    "device": "cpu",
    "num_members": 2,
    "grasp_channels": 4,
    "navigation_hidden": 16,
    "grasp_batch_size": 4,
    "navigation_batch_size": 4,
    "min_attempts_to_update": 1,
    "min_steps_to_update": 1,
    "refreshed_maps": 0,  # all: the kept ones are not saved
}


def make_learner(seed: int = 0):
    actor = make_actor(ReLMMConfig(seed=seed, **SMALL))
    replay = Replay(1000)
    pictures = np.random.default_rng(0).integers(0, 256, (12, 100, 100, 3), np.uint8)
    for number, picture in enumerate(pictures):
        grasp = number % 2
        replay.add(picture, (0.0, 0.0), [0.2, 30.0, grasp, 0.35, 0.0], success=number % 4 == 1, phase=1)
    return actor, Learner(actor.policy, replay, seed)


def work(learner: Learner, times: int) -> None:
    for _ in range(times):
        learner.update_grasping(Phase.LEARNING)
        learner.update_navigation()


def test_restored_learner_goes_on_as_if_nothing_had_happened(tmp_path):
    actor, learner = make_learner()
    rng = np.random.default_rng(5)
    work(learner, 2)
    save_checkpoint(tmp_path, 7, actor, learner, rng, {"episodes": 3}, {"steps": 10})
    work(learner, 2)
    wanted = [rng.random(), float(torch.rand(1, generator=learner.policy.rng))]

    other_actor, other = make_learner(seed=1)
    other_rng = np.random.default_rng(0)
    folder = last_checkpoint(tmp_path)
    policy_class = type(other_actor.policy)
    other.policy.load_state_dict(policy_class.from_pretrained(pretrained_model(folder)).state_dict())
    other.maps.version = 2  # the map cache is not saved, but rebuilt
    assert load_training_state(folder, other, other_rng) == {"episodes": 3}
    assert [other_rng.random(), float(torch.rand(1, generator=other.policy.rng))] == wanted
    work(other, 2)
    for (name, mine), theirs in zip(
        learner.policy.state_dict().items(), other.policy.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5, msg=name)


@pytest.mark.parametrize("crash_at", [1, 2])
def test_crash_between_the_renames_leaves_the_last_checkpoint(tmp_path, monkeypatch, crash_at):
    actor, learner = make_learner()
    rng = np.random.default_rng(0)
    save_checkpoint(tmp_path, 1, actor, learner, rng, {"episodes": 1}, {})
    replace, calls = os.replace, []

    def dying(*arguments):
        calls.append(arguments)
        if len(calls) == crash_at:
            raise KeyboardInterrupt
        replace(*arguments)

    monkeypatch.setattr(module.os, "replace", dying)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path, 2, actor, learner, rng, {"episodes": 2}, {})
    monkeypatch.undo()
    assert last_checkpoint(tmp_path).name == "000001"
    assert load_training_state(last_checkpoint(tmp_path), learner, rng) == {"episodes": 1}
    save_checkpoint(tmp_path, 2, actor, learner, rng, {"episodes": 2}, {})
    assert last_checkpoint(tmp_path).name == "000002"


CHILD = """
import sys, numpy as np
from pathlib import Path
sys.path.insert(0, {folder!r})
from test_checkpoint import make_learner, work
from relmm.learning.checkpoint import save_checkpoint
actor, learner = make_learner()
step = 0
while True:
    step += 1
    save_checkpoint(Path({target!r}), step % 3, actor, learner, np.random.default_rng(0), {{"episodes": step}}, {{}})
    print(step, flush=True)
"""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_killed_while_saving_leaves_a_whole_checkpoint(tmp_path):
    code = CHILD.format(folder=os.path.dirname(__file__), target=str(tmp_path / "checkpoints"))
    rng = np.random.default_rng(0)
    _, learner = make_learner()
    for _ in range(8):
        child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        saved = [int(child.stdout.readline()) for _ in range(3)][-1]
        time.sleep(float(rng.uniform(0, 0.2)))
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        counters = load_training_state(last_checkpoint(tmp_path / "checkpoints"), learner, np.random.default_rng(0))
        assert counters["episodes"] >= saved


def test_checkpoint_of_other_networks_is_refused(tmp_path):
    actor, learner = make_learner()
    folder = save_checkpoint(tmp_path, 1, actor, learner, np.random.default_rng(0), {}, {})
    check_same_networks(folder, ReLMMConfig(**SMALL).fingerprint())
    other = ReLMMConfig(**{**SMALL, "num_members": 3}).fingerprint()
    with pytest.raises(ConfigError, match="num_members is 2, not 3"):
        check_same_networks(folder, other)


def test_damaged_training_state_is_one_sentence(tmp_path):
    actor, learner = make_learner()
    folder = save_checkpoint(tmp_path, 1, actor, learner, np.random.default_rng(0), {}, {})
    (folder / "training_state" / "relmm_state.json").write_text("{", encoding="utf-8")
    with pytest.raises(ConfigError, match="resume another"):
        load_training_state(folder, learner, np.random.default_rng(0))


def test_no_checkpoint_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="There is no checkpoint"):
        last_checkpoint(tmp_path)
