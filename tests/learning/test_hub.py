"""Checkpoints on their way to the Hub and back, over real HTTP."""

import json
import re

import numpy as np
import pytest
from safetensors.torch import load, save

from relmm.commands.policies import make_actor
from relmm.episodes import UploadedDataset
from relmm.errors import ConfigError, HubError
from relmm.learning.checkpoint import install_checkpoint, last_checkpoint, load_training_state, save_checkpoint
from relmm.learning.hub import fetch_checkpoint, fetch_policy, upload_checkpoint
from relmm.learning.progress import Progress
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


DAMAGES = {
    "shape": (ADAM, tensors_with(lambda t: t[:1].contiguous()), "does not fit its weight"),
    "NaN": (ADAM, tensors_with(lambda t: t * float("nan")), "does not fit its weight"),
    "cut": (ADAM, lambda content: content[:-10], "cannot be read"),
    "missing": (ADAM, None, "cannot be read"),
    "counters": (STATE, json_with(counters={"episodes": -1}), "episodes is -1"),
    "no counters": (STATE, json_with(counters=[]), "cannot be read"),
    "generator": (
        STATE,
        json_with(random={"trainer": {"bit_generator": "os.system"}, "learner": {}}),
        "cannot be read",
    ),
    "nonsense": (STATE, lambda content: b"nonsense", "cannot be read"),
}


@pytest.mark.parametrize(("name", "damage", "words"), DAMAGES.values(), ids=DAMAGES)
def test_damaged_training_state(save_step, name, damage, words):
    path = save_step(7) / name
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


LINE = json.dumps(Progress().asdict()).encode()[:-1] + b', "seconds": '


@pytest.mark.parametrize(
    "content",
    [
        b"[]",
        b'"steps"',
        b'{"steps": 1}',
        LINE + b'"long"}',
        LINE + b"NaN}",
        LINE + b'1, "eval_collected": 0.5}',
        LINE + b'1, "eval_collected_std": 0, "eval_collected_each": [], "eval_collected": ["much"]}',
        b"\xff\xfe",
        b"[" * 100_000,
    ],
)
def test_nonsense_in_the_metrics(hub, save_step, content):
    push(save_step(7))
    repo = hub.repo(NAME)
    healthy = LINE + b'2.5, "eval_collected": 0.5, "eval_collected_std": 0.1, "eval_collected_each": [0.4, 0.6]}\n'
    repo.commit(repo.files | {"metrics.jsonl": healthy})
    fetch_checkpoint(NAME, "main")
    repo.commit(repo.files | {"metrics.jsonl": healthy + content + b"\n"})
    with pytest.raises(ConfigError, match="has lines that are no metrics of a run"):
        fetch_checkpoint(NAME, "main")
