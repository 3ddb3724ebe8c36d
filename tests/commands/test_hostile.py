"""Policies from anybody: whatever is wrong with them, a command refuses it in one sentence before anything happens."""

import json
import pickle
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load, save

from relmm.commands import evaluate, record, train, upload
from relmm.commands.policies import make_actor, policy_from_path
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

WEIGHTS = "model.safetensors"


@pytest.fixture(scope="module")
def healthy(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("healthy")
    config = ReLMMConfig(device="cpu", num_members=2, channels=4)
    make_actor(config).save_pretrained(folder)
    return folder


@pytest.fixture
def policy(healthy, tmp_path) -> dict[str, bytes]:
    """The files of a policy, to be damaged."""
    return {path.name: path.read_bytes() for path in healthy.iterdir()}


@pytest.fixture
def refused(monkeypatch, capsys, tmp_path) -> Callable[..., str]:
    """The one sentence that a command ends in."""

    def call(main: Callable[[], None], *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["command", *arguments, f"--output_dir={tmp_path / 'out'}"])
        with pytest.raises(SystemExit) as stop:
            main()
        lines = capsys.readouterr().err.strip().splitlines()
        assert stop.value.code == 2, lines
        assert [line.startswith("relmm-") for line in lines if "Fetching" not in line] == [True]
        assert not (tmp_path / "out").exists()
        return lines[-1]

    return call


def changed_config(**changes: object) -> Callable[[dict[str, bytes]], None]:
    def damage(files: dict[str, bytes]) -> None:
        files["config.json"] = json.dumps(json.loads(files["config.json"]) | changes).encode()

    return damage


def changed_step(**changes: object) -> Callable[[dict[str, bytes]], None]:
    def damage(files: dict[str, bytes]) -> None:
        pipeline = json.loads(files["policy_preprocessor.json"])
        pipeline["steps"][0] |= changes
        files["policy_preprocessor.json"] = json.dumps(pipeline).encode()

    return damage


def changed_weights(change: Callable[[dict[str, torch.Tensor]], object]) -> Callable[[dict[str, bytes]], None]:
    def damage(files: dict[str, bytes]) -> None:
        tensors = load(files[WEIGHTS])
        change(tensors)
        files[WEIGHTS] = save(tensors)

    return damage


def first(tensors: dict[str, torch.Tensor]) -> str:
    return sorted(name for name in tensors if tensors[name].ndim > 1)[0]


def header_claims(size: int) -> bytes:
    """A file of a few bytes whose header promises a tensor of `size` bytes."""
    header = json.dumps({"weight": {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}}).encode()
    return struct.pack("<Q", len(header)) + header + b"\0" * 16


class Bomb:
    """What a pickle could do."""

    def __reduce__(self):
        return (Path.touch, (Path("/tmp/relmm-was-executed"),))


def replaced(name: str, content: bytes) -> Callable[[dict[str, bytes]], object]:
    return lambda files: files.__setitem__(name, content)


DAMAGES: dict[str, tuple[Callable[[dict[str, bytes]], object], str]] = {
    "another class": (changed_config(type="walker"), "a policy 'walker', and this loads act, "),
    "no such class": (changed_config(type="os.system"), "a policy 'os.system'"),
    "no class": (replaced("config.json", b"{}"), "a policy None"),
    "another controller": (changed_config(type="relmm_random", num_grasp=2), "No policy can be loaded"),
    "unknown setting": (changed_config(sudo=True), "sudo"),
    "setting out of range": (changed_config(num_members=0), "policy.num_members is 0"),
    "huge networks": (changed_config(channels=1024, num_members=100), "does not fit its config"),
    "other pictures": (
        changed_config(input_features={"observation.images.front": {"type": "VISUAL", "shape": [3, 200, 200]}}),
        "expects observation.images.front of (3, 200, 200), and relmm has (3, 100, 100)",
    ),
    "no JSON": (replaced("config.json", b"\xff\xfe nonsense"), "is no JSON that can be read"),
    "deep JSON": (replaced("config.json", b"[" * 100_000), "is no JSON that can be read"),
    "large JSON": (replaced("config.json", b" " * (11 << 20)), "which no policy needs"),
    "code in a processor": (
        changed_step(**{"class": "subprocess.Popen", "config": {"args": ["true"]}}),
        "has a step 'subprocess.Popen'",
    ),
    "foreign step": (changed_step(registry_name="tokenizer_processor"), "has a step 'tokenizer_processor'"),
    "renamed pictures": (
        changed_step(config={"rename_map": {"observation.state": "action"}}),
        "the setting 'rename_map'",
    ),
    "half precision": (changed_step(registry_name="device_processor", config={"float_dtype": "float16"}), "'float16'"),
    "other numbers": (
        changed_step(registry_name="normalizer_processor", config={"norm_map": {"STATE": "MEAN_STD"}}),
        "the setting 'norm_map'",
    ),
    "NaN in statistics": (
        lambda files: (
            changed_step(state_file="stats.safetensors")(files),
            files.update({"stats.safetensors": save({"action.mean": torch.tensor(float("nan"))})}),
        ),
        "stats.safetensors has numbers that are not finite",
    ),
    "no statistics": (changed_step(state_file="stats.safetensors"), "stats.safetensors is cut off, or no safetensors"),
    "normalization": (
        changed_config(normalization_mapping={"STATE": "MEAN_STD"}),
        "normalization_mapping must be IDENT",
    ),
    "normalization of what is not": (
        changed_config(normalization_mapping={"x": "IDENTITY"}),
        "normalization_mapping must",
    ),
    "huge batches": (changed_config(batch_size=10**23), "policy.batch_size is 1000"),
    "huge seed": (changed_config(seed=10**23), "policy.seed is 1000"),
    "no device": (changed_config(device="../.."), "No policy can be loaded"),
    "file elsewhere": (changed_step(state_file="../../secret.safetensors"), "which is not in its folder"),
    "absolute file": (changed_step(state_file="/etc/passwd"), "which is not in its folder"),
    "no processor": (lambda files: files.pop("policy_preprocessor.json"), "has no policy_preprocessor.json"),
    "no weights": (lambda files: files.pop(WEIGHTS), "has no model.safetensors"),
    "missing key": (changed_weights(lambda t: t.pop(first(t))), "1 missing (grasping"),
    "extra key": (changed_weights(lambda t: t.update(more=torch.zeros(1))), "1 too many (more)"),
    "wrong shape": (changed_weights(lambda t: t.update({first(t): torch.zeros(3, 3)})), "is torch.float32 (3, 3), not"),
    "wrong type": (changed_weights(lambda t: t.update({first(t): t[first(t)].double()})), "is torch.float64"),
    "NaN": (changed_weights(lambda t: t[first(t)].fill_(float("nan"))), "that are not finite"),
    "huge weights": (changed_weights(lambda t: t[first(t)].fill_(1e30)), "that are not finite, or above 1000"),
    "truncated": (lambda files: files.update({WEIGHTS: files[WEIGHTS][:-1000]}), "is cut off, or no safetensors"),
    "10 GB claimed": (replaced(WEIGHTS, header_claims(10 << 30)), "is cut off, or no safetensors"),
    "10 GB of header": (replaced(WEIGHTS, struct.pack("<Q", 10 << 30) + b"{}"), "is cut off, or no safetensors"),
    "a pickle": (replaced(WEIGHTS, pickle.dumps(Bomb())), "is cut off, or no safetensors"),
    "empty": (replaced(WEIGHTS, b""), "is cut off, or no safetensors"),
}


@pytest.mark.parametrize(("damage", "words"), DAMAGES.values(), ids=DAMAGES)
def test_damaged_policy(tmp_path, policy, refused, damage, words):
    damage(policy)
    (tmp_path / "policy").mkdir()
    for name, content in policy.items():
        (tmp_path / "policy" / name).write_bytes(content)
    assert words in refused(evaluate.main, f"--policy.path={tmp_path / 'policy'}", "--eval.n_episodes=1")
    assert not Path("/tmp/relmm-was-executed").exists()


OF_FIRST_VERSION = "is of relmm 0.1.0, whose policy relmm had other networks than this version's; use it with relmm 0.1"
RECORDING = ("--robot.type=locobot_sim", "--dataset.repo_id=me/room", "--dataset.num_episodes=1")


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (evaluate.main, ["--policy.path={model}"]),
        (record.main, ["--policy.path={model}", "--dataset.root={out}", *RECORDING]),
        (train.main, ["--policy.path={model}", "--robot.type=locobot_sim", "--output_dir={out}"]),
        (train.main, ["--resume=true", "--output_dir={run}"]),
        (train.main, ["--config_path={model}/train_config.json", "--output_dir={out}"]),
        (upload.main, ["--output_dir={run}", "--policy.repo_id=me/policy"]),
    ],
    ids=["eval", "record", "train from it", "resume", "its settings", "upload"],
)
def test_policies_of_the_first_version_are_refused(first_version, monkeypatch, capsys, tmp_path, main, arguments):
    places = {
        "model": first_version / "checkpoints/last/pretrained_model", "run": first_version, "out": tmp_path / "out"
    }  # fmt: skip
    before = sorted(first_version.rglob("*"))
    monkeypatch.setattr(sys, "argv", ["command", *(argument.format(**places) for argument in arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("relmm-")
    assert OF_FIRST_VERSION in line
    assert not (tmp_path / "out").exists()
    assert sorted(first_version.rglob("*")) == before


def test_policies_of_the_first_version_on_the_hub_are_refused(hub, first_version, refused):
    model = first_version / "checkpoints/last/pretrained_model"
    hub.create("me/old", files={path.name: path.read_bytes() for path in model.iterdir()})
    assert OF_FIRST_VERSION in refused(evaluate.main, "--policy.path=me/old")
    assert OF_FIRST_VERSION in refused(train.main, "--resume=true", "--policy.path=me/old")


def test_a_device_of_another_machine_is_not_used(tmp_path, policy, monkeypatch):
    changed_config(device="cuda:99")(policy)
    for name, content in policy.items():
        (tmp_path / name).write_bytes(content)
    monkeypatch.setattr("lerobot.configs.policies.is_torch_device_available", lambda device: True)
    monkeypatch.setattr(sys, "argv", ["command", f"--policy.path={tmp_path}"])
    assert policy_from_path(None).device in ("cpu", "cuda", "mps")


@pytest.mark.parametrize("name", ["code in a processor", "NaN", "another class"])
def test_damaged_policy_on_the_hub(hub, policy, refused, name):
    damage, words = DAMAGES[name]
    damage(policy)
    hub.create("you/evil", files=policy)
    assert words in refused(evaluate.main, "--policy.path=you/evil", "--eval.n_episodes=1")
    assert words in refused(train.main, "--policy.path=you/evil", "--robot.type=locobot_sim")


def test_list_of_files_that_leave_their_folder(hub, policy, refused):
    hub.create("you/evil", files={**policy, "../../evil.json": b"{}"})
    assert "would leave its folder" in refused(evaluate.main, "--policy.path=you/evil")


def test_weights_that_are_too_large_are_not_downloaded(hub, policy, refused, monkeypatch):
    monkeypatch.setattr("relmm.learning.hub.POLICY_FILES", {"*": 1000})
    hub.create("you/evil", files=policy)
    assert "and at most 0 MB are plausible" in refused(evaluate.main, "--policy.path=you/evil")
    assert not any("/resolve/" in request for request in hub.requests)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("me/nothing", "the Hub has no model me/nothing that you may read"),
        ("me/policy@v9", "the model me/policy on the Hub has no revision 'v9'"),
        ("not a name", "No policy can be loaded from 'not a name'"),
    ],
)
def test_no_such_policy(hub, policy, refused, path, words):
    hub.create("me/policy", files=policy)
    assert words in refused(evaluate.main, f"--policy.path={path}")


def test_training_cannot_go_on_from_weights_alone(hub, policy, refused):
    hub.create("me/policy", files=policy)
    error = refused(train.main, "--resume=true", "--policy.path=me/policy")
    assert "has no training_state/dataset.json, so training cannot go on from it" in error
