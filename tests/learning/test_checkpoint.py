"""Checkpoints: what is saved comes back, and a crash at any moment leaves the last one whole."""

import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from relmm.commands.policies import make_actor
from relmm.errors import ConfigError, DiskError
from relmm.features import STATE_NAMES, Phase, Skill
from relmm.learning import checkpoint as module
from relmm.learning.checkpoint import (
    check_same_networks,
    last_checkpoint,
    load_training_state,
    pretrained_model,
    save_checkpoint,
)
from relmm.learning.untrusted import check_policy_folder
from relmm.policies.learning import Learner, LearningConfig
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_single.configuration_relmm_single import RelmmSingleConfig

LITTLE = {"device": "cpu", "num_members": 2, "min_attempts_to_update": 1}
SMALL = {**LITTLE, "channels": 4, "batch_size": 4}
PAPER = {
    **LITTLE,
    "grasp_channels": 4,
    "navigation_encoder": "paper_small",
    "navigation_hidden": 8,
    "grasp_batch_size": 4,
    "navigation_batch_size": 4,
    "min_steps_to_update": 1,
}


SINGLE: dict[str, object] = {
    "device": "cpu",
    "encoder": "paper_small",
    "hidden": 8,
    "batch_size": 4,
    "min_steps_to_update": 2,
}


def make_config(kind: str, **settings) -> LearningConfig:
    if kind == "relmm":
        return ReLMMConfig(**{**SMALL, **settings})
    if kind == "relmm_single":
        return RelmmSingleConfig(**{**SINGLE, **settings})
    return RelmmPaperConfig(**{**PAPER, **settings, **({"perturbation": "novelty"} if kind == "novelty" else {})})


def make_learner(kind: str = "relmm", seed: int = 0):
    actor = make_actor(make_config(kind, seed=seed))
    actor.policy.train()
    learner = actor.policy.make_learner(seed, 1000)
    pictures = np.random.default_rng(0).integers(0, 256, (12, 100, 100, 3), np.uint8)
    for number, picture in enumerate(pictures):
        skill = Skill.GRASP if number % 2 else Skill.NAVIGATE
        action = np.array([0.2, 30.0, skill, 0.35, 0.0], np.float32)
        learner.add(picture, np.zeros(len(STATE_NAMES), np.float32), action, number % 4 == 1, Phase.LEARNING)
    for picture in pictures[:4]:
        learner.add(
            picture, np.zeros(len(STATE_NAMES), np.float32), np.float32([0.2, 30, 0, 0, 0]), False, Phase.PSEUDO_RESET
        )
    return actor, learner


def work(learner: Learner, times: int) -> None:
    for _ in range(times):
        learner.update_grasping(Phase.LEARNING)
        learner.update_navigation()
        learner.update_pseudo_reset()


@pytest.mark.parametrize("kind", ["relmm", "relmm_paper", "novelty", "relmm_single"])
def test_restored_learner_goes_on_as_if_nothing_had_happened(tmp_path, kind, monkeypatch):
    monkeypatch.setattr("relmm.policies.relmm_paper.learner.MIN_PERTURBATION_STEPS", 2)
    actor, learner = make_learner(kind)
    rng = np.random.default_rng(5)
    work(learner, 2)
    save_checkpoint(tmp_path, 7, actor, learner, rng, {"episodes": 3}, {"steps": 10}, [])
    work(learner, 2)
    wanted = [rng.random(), learner.rng.random(), float(torch.rand(1, generator=learner.noise))]

    other_actor, other = make_learner(kind, seed=1)
    other_rng = np.random.default_rng(0)
    folder = last_checkpoint(tmp_path)
    saved = type(other_actor.policy).from_pretrained(pretrained_model(folder))
    other_actor.policy.load_state_dict(saved.state_dict())
    assert load_training_state(folder, other, other_rng) == {"episodes": 3}
    work(other, 2)
    theirs = other_actor.policy.state_dict()
    for name, mine in actor.policy.state_dict().items():
        torch.testing.assert_close(mine, theirs[name], rtol=1e-5, atol=1e-6, msg=name)
    assert [other_rng.random(), other.rng.random(), float(torch.rand(1, generator=other.noise))] == wanted


@pytest.mark.parametrize("crash_at", [1, 2])
def test_crash_between_the_renames_leaves_the_last_checkpoint(tmp_path, monkeypatch, crash_at):
    actor, learner = make_learner()
    rng = np.random.default_rng(0)
    save_checkpoint(tmp_path, 1, actor, learner, rng, {"episodes": 1}, {}, [])
    replace, calls = os.replace, []

    def dying(*arguments):
        calls.append(arguments)
        if len(calls) == crash_at:
            raise KeyboardInterrupt
        replace(*arguments)

    monkeypatch.setattr(module.os, "replace", dying)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path, 2, actor, learner, rng, {"episodes": 2}, {}, [])
    monkeypatch.undo()
    assert last_checkpoint(tmp_path).name == "000001"
    assert load_training_state(last_checkpoint(tmp_path), learner, rng) == {"episodes": 1}
    save_checkpoint(tmp_path, 2, actor, learner, rng, {"episodes": 2}, {}, [])
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
    counters = {{"episodes": step}}
    save_checkpoint(Path({target!r}), step % 3, actor, learner, np.random.default_rng(0), counters, {{}}, [])
    print(step, flush=True)
"""


@pytest.mark.slow
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


@pytest.mark.parametrize("kind", ["relmm", "relmm_paper"])
def test_checkpoint_of_other_networks_is_refused(tmp_path, kind):
    actor, learner = make_learner(kind)
    folder = save_checkpoint(tmp_path, 1, actor, learner, np.random.default_rng(0), {}, {}, [])
    check_same_networks(folder, make_config(kind).fingerprint())
    with pytest.raises(ConfigError, match="num_members is 2, not 3"):
        check_same_networks(folder, make_config(kind, num_members=3).fingerprint())
    with pytest.raises(ConfigError, match=r"resume it with its own train_config\.json"):
        check_same_networks(folder, make_config("relmm" if kind == "relmm_paper" else "relmm_paper").fingerprint())


def test_damaged_training_state_is_one_sentence(tmp_path):
    actor, learner = make_learner()
    folder = save_checkpoint(tmp_path, 1, actor, learner, np.random.default_rng(0), {"episodes": 0}, {}, [])
    (folder / "training_state" / "relmm_state.json").write_text("{", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"'relmm_state\.json' is not what SHA256SUMS says"):
        load_training_state(folder, learner, np.random.default_rng(0))


def test_a_full_disk_is_one_sentence_and_leaves_the_last_checkpoint(tmp_path):
    """Whatever file is the first that does not fit."""
    actor, learner = make_learner()
    work(learner, 1)
    save_checkpoint(tmp_path, 1, actor, learner, np.random.default_rng(0), {"episodes": 1}, {}, [])
    sizes = {path.stat().st_size for path in (tmp_path / "000001").rglob("*") if path.is_file()}
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond the limit then fails with EFBIG
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        for size in sizes:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))
            with pytest.raises(DiskError, match="make room") as caught:
                save_checkpoint(tmp_path, 2, actor, learner, np.random.default_rng(0), {"episodes": 2}, {}, [])
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            assert "\n" not in str(caught.value)
            assert last_checkpoint(tmp_path).name == "000001"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    save_checkpoint(tmp_path, 2, actor, learner, np.random.default_rng(0), {"episodes": 2}, {}, [])
    assert load_training_state(last_checkpoint(tmp_path), learner, np.random.default_rng(0)) == {"episodes": 2}


def test_a_checkpoint_without_check_sums_still_loads(tmp_path):
    actor, learner = make_learner()
    folder = save_checkpoint(tmp_path, 1, actor, learner, np.random.default_rng(0), {"episodes": 1}, {}, [])
    for sums in folder.rglob("SHA256SUMS"):
        sums.unlink()
    check_policy_folder(pretrained_model(folder))
    assert load_training_state(folder, learner, np.random.default_rng(0)) == {"episodes": 1}


def test_no_checkpoint_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="There is no checkpoint"):
        last_checkpoint(tmp_path)
