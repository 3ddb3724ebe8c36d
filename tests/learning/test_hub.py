"""Checkpoints on their way to the Hub and back, over real HTTP."""

import json
import re

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from relmm.commands.policies import make_actor
from relmm.episodes import UploadedDataset
from relmm.errors import ConfigError, HubError
from relmm.learning.checkpoint import (
    install_checkpoint,
    last_checkpoint,
    load_training_state,
    save_checkpoint,
)
from relmm.learning.hub import fetch_checkpoint, fetch_policy, upload_checkpoint
from relmm.learning.settings import portable_settings
from relmm.learning.sums import SUMS
from relmm.learning.untrusted import check_policy_folder
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

NAME = "me/policy"
RUNS = [{"first_episode": 0, "seed": 1}]
DATASET = UploadedDataset("me/life", "a" * 40, 3)
STATE = "training_state/relmm_state.json"
ADAM = "training_state/grasping/optimizer_state.safetensors"
SETTINGS = {
    "policy": {"type": "relmm", "push_to_hub": True, "repo_id": "me/policy", "updates": 3},
    "dataset": {"repo_id": "me/life", "root": "/home/me/secret", "push_to_hub": True},
    "hub": {"every": 100},
    "output_dir": "/home/me/runs/first",
}


def small_learner() -> tuple:
    actor = make_actor(ReLMMConfig(device="cpu", num_members=2, channels=4))
    learner = actor.policy.make_learner(seed=0, capacity=1000)
    for optimizer in learner.optimizers.values():  # a step, so that there is a state
        for group in optimizer.param_groups:
            for weight in group["params"]:
                weight.grad = weight.detach().clone()
        optimizer.step()
    return actor, learner


@pytest.fixture
def save_step(tmp_path):
    actor, learner = small_learner()

    def save(step: int):
        counters = {"episodes": 3, "interventions": 1}
        return save_checkpoint(
            tmp_path / "checkpoints", step, actor, learner, np.random.default_rng(5), counters, SETTINGS, RUNS
        )

    return save


def push(checkpoint, runs=RUNS, dataset=DATASET, private=None) -> str:
    def decorate(folder):
        (folder / "README.md").write_text("a card")

    return upload_checkpoint(checkpoint, NAME, private=private, dataset=dataset, runs=runs, decorate=decorate)


def test_upload_and_download(hub, save_step, tmp_path):
    checkpoint = save_step(7)
    before = {path: path.read_bytes() for path in checkpoint.rglob("*") if path.is_file()}
    revision = push(checkpoint)
    assert {path: path.read_bytes() for path in checkpoint.rglob("*") if path.is_file()} == before
    folder = fetch_policy(f"{NAME}@{revision}")
    for name in ("config.json", "model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json"):
        assert (folder / name).read_bytes() == (checkpoint / "pretrained_model" / name).read_bytes()
    assert not (folder / "training_state").exists(), "who evaluates does not need it"
    folder, source = fetch_checkpoint(NAME, "main")
    assert (source.step, source.repo_id, source.revision, source.episodes) == (7, "me/life", "a" * 40, 3)
    install_checkpoint(tmp_path / "run", source.step, folder, ["config.json", "model.safetensors"])
    installed = last_checkpoint(tmp_path / "run")
    for path in (checkpoint / "training_state").rglob("*.*"):
        assert (installed / "training_state" / path.relative_to(checkpoint / "training_state")).read_bytes() == (
            path.read_bytes()
        )
    actor, learner = small_learner()
    assert load_training_state(installed, learner, np.random.default_rng()) == {"episodes": 3, "interventions": 1}


def test_what_belongs_to_one_machine_stays_there(hub, save_step):
    push(save_step(7))
    settings = json.loads(hub.repo(NAME).files["train_config.json"])
    assert "/home/me" not in json.dumps(settings)
    assert settings["policy"]["updates"] == 3
    assert (settings["policy"]["push_to_hub"], settings["policy"]["repo_id"]) == (False, None)
    assert (settings["dataset"]["push_to_hub"], settings["hub"]) == (False, {})


def test_a_flipped_bit_is_noticed(hub, save_step):
    def load(checkpoint):
        check_policy_folder(checkpoint / "pretrained_model")
        load_training_state(checkpoint, small_learner()[1], np.random.default_rng())

    checkpoint = save_step(7)
    push(checkpoint)
    for file in sorted(checkpoint.rglob("*")):
        if file.is_file() and file.name != "train_config.json":
            content = file.read_bytes()
            middle = len(content) // 2
            file.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
            with pytest.raises(ConfigError) as caught:
                load(checkpoint)
            assert "\n" not in str(caught.value)
            file.write_bytes(content)
    repo = hub.repo(NAME)
    weights = bytearray(repo.files["model.safetensors"])
    weights[-1] ^= 1
    repo.commit(repo.files | {"model.safetensors": bytes(weights)})
    with pytest.raises(ConfigError, match=r"is damaged: 'model\.safetensors' is not what SHA256SUMS says"):
        fetch_policy(NAME)


def test_a_learning_rate_is_the_runs_own(save_step):
    """Whatever the file says: 1e30 would make NaN of all weights at the first step."""
    checkpoint = save_step(7)
    (checkpoint / "training_state" / SUMS).unlink()
    groups = checkpoint / "training_state/grasping/optimizer_param_groups.json"
    for value in ("NaN", "1e30", "[" * 100_000):
        groups.write_text(re.sub(r'"lr": [^,]*,', f'"lr": {value},', groups.read_text()))
        _, learner = small_learner()
        before = learner.optimizers["grasping"].param_groups[0] | {"params": None}
        load_training_state(checkpoint, learner, np.random.default_rng())
        assert learner.optimizers["grasping"].param_groups[0] | {"params": None} == before


def test_settings_from_elsewhere_name_no_file_and_no_device():
    evil = {
        "policy": {"type": "relmm", "updates": 3, "device": "cuda:7", "path": "you/evil", "pretrained_path": "/etc"},
        "dataset": {"repo_id": "me/life", "root": "/etc", "follow": "/etc", "init": "/home/me/other", "license": "mit"},
        "robot": {"type": "locobot_sim", "room": "diverse", "calibration_dir": "/etc", "port": "/dev/ttyUSB0"},
        "job_name": "../../evil",
        "output_dir": "/etc",
        "num_threads": 100_000,
        "steps": 20,
    }
    settings = portable_settings(evil)
    assert not re.search(r"/etc|/dev|/home|\.\.|evil|cuda|100000", json.dumps(settings))
    assert (settings["steps"], settings["policy"]["updates"], settings["robot"]["room"]) == (20, 3, "diverse")
    assert (settings["dataset"]["repo_id"], settings["dataset"]["license"]) == ("me/life", "mit")
    evil["dataset"]["init"] = "me/first@main"
    assert portable_settings(evil)["dataset"]["init"] == "me/first@main"
    for bad in ([], None, "", {"policy": []}, {"policy": {}, "dataset": {}, "robot": "x"}):
        with pytest.raises(ConfigError, match="has no settings of policy, dataset and robot"):
            portable_settings(bad)


def test_later_checkpoints_replace_earlier_ones(hub, save_step):
    first = push(save_step(7))
    second = push(save_step(9))
    assert fetch_checkpoint(NAME, "main")[1].step == 9
    assert fetch_checkpoint(NAME, first)[1].step == 7
    assert hub.repo(NAME).refs["main"] == second


def test_private(hub, save_step):
    push(save_step(7), private=True)
    assert hub.repo(NAME).private


def test_another_run_is_not_replaced(hub, save_step):
    push(save_step(7))
    files = hub.repo(NAME).files
    for runs, words in (
        ([{"first_episode": 0, "seed": 2}], "comes from another run"),
        ([], "comes from another run"),
    ):
        with pytest.raises(HubError, match=words):
            push(save_step(9), runs=runs)
    with pytest.raises(HubError, match="has learned for 7 steps and this one for 5"):
        push(save_step(5))
    push(save_step(9), runs=[*RUNS, {"first_episode": 3, "seed": 4}])
    with pytest.raises(HubError, match="goes on from this one, so somebody else works with it"):
        push(save_step(11))
    hub.create(NAME, files={"config.json": b"{}"})
    with pytest.raises(HubError, match="comes from another run"):
        push(save_step(7))
    assert "model.safetensors" in files


def test_two_writers_at_the_same_moment(hub, save_step):
    push(save_step(7))
    hub.hooks.append(lambda repo: repo.commit(repo.files | {"note.md": b"someone was faster"}))
    with pytest.raises(HubError, match="somebody else wrote to the model me/policy at the same moment"):
        push(save_step(9))
    hub.hooks.clear()
    push(save_step(9))
    assert hub.repo(NAME).files["note.md"] == b"someone was faster"


def json_with(**changes):
    return lambda content: json.dumps(json.loads(content) | changes).encode()


def tensors_with(change):
    def damage(content):
        tensors = load(content)
        name = next(name for name in sorted(tensors) if tensors[name].ndim > 1)
        tensors[name] = change(tensors[name])
        return save(tensors)

    return damage


def moment(key, change):
    """Another moment of the first weight."""

    def damage(content):
        tensors = load(content)
        tensors[f"state/0/{key}"] = change(tensors[f"state/0/{key}"])
        return save(tensors)

    return damage


OTHER = "moments of weight 0 that no gradients have"
DAMAGES = {
    "shape": (ADAM, tensors_with(lambda t: t[:1].contiguous()), "does not fit its config"),
    "NaN": (ADAM, tensors_with(lambda t: t * float("nan")), "that are not finite"),
    "huge": (ADAM, moment("exp_avg", lambda t: t * 1e30), OTHER),
    "tiny square": (ADAM, moment("exp_avg_sq", lambda t: t * 0), OTHER),
    "negative square": (ADAM, moment("exp_avg_sq", lambda t: -t), OTHER),
    "before the first step": (ADAM, moment("step", lambda t: t - 2), OTHER),
    "half of them": (
        ADAM,
        lambda content: save({k: v for k, v in load(content).items() if k[-4:] != "step"}),
        "missing",
    ),
    "more": (ADAM, lambda content: save(load(content) | {"state/99/step": torch.zeros(())}), "too many"),
    "cut": (ADAM, lambda content: content[:-10], "cannot be read"),
    "missing": (ADAM, None, "cannot be read"),
    "counters": (STATE, json_with(counters={"episodes": -1}), "episodes is -1"),
    "huge counters": (STATE, json_with(counters={"episodes": 10**23}), "episodes is 1000"),
    "no counters": (STATE, json_with(counters=[]), "cannot be read"),
    "no cursor": (STATE, json_with(counters={"interventions": 1}), "cannot be read"),
    "generator": (
        STATE,
        json_with(random={"trainer": {"bit_generator": "os.system"}, "learner": {}}),
        "cannot be read",
    ),
    "nonsense": (STATE, lambda content: b"nonsense", "no JSON that can be read"),
    "deep": (STATE, lambda content: b"[" * 100_000, "no JSON that can be read"),
}


@pytest.mark.parametrize(("name", "damage", "words"), DAMAGES.values(), ids=DAMAGES)
def test_damaged_training_state(save_step, name, damage, words):
    path = save_step(7) / name
    (save_step(7) / "training_state" / SUMS).unlink()  # which would notice any of them
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(damage(path.read_bytes()))
    _, learner = small_learner()
    with pytest.raises(ConfigError, match=words) as caught:
        load_training_state(path.parents[2 if "grasping" in name else 1], learner, np.random.default_rng())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [b"[]", b"{}", b'{"step": "7"}', b'{"step": 7, "repo_id": 1, "revision": null, "episodes": 3, "runs": []}'],
)
def test_nonsense_about_the_dataset(hub, save_step, content):
    push(save_step(7))
    repo = hub.repo(NAME)
    repo.commit(repo.files | {"training_state/dataset.json": content})
    with pytest.raises(ConfigError, match=re.escape("does not say what the checkpoint was trained on")):
        fetch_checkpoint(NAME, "main")
