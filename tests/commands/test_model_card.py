"""The model card says what the run's own files say."""

import json

import draccus
import pytest
from huggingface_hub import ModelCard

from relmm.commands.model_card import ModelFacts, model_card
from relmm.commands.train_config import TrainConfig
from relmm.episodes import UploadedDataset
from relmm.features import STATE_NAMES
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.sim.config_locobot_sim import LocobotSimConfig

COUNTS = {"attempts": 40, "successes": 10, "objects": 7, "pseudo_reset_steps": 120, "interventions": 3} | {
    "robot_minutes": 12.3,
    "practice_attempts": 0,
    "seconds": 9.0,
}
LINES = [
    {"steps": 50, **COUNTS, "grasp_loss": 0.5},
    {
        "steps": 100,
        **COUNTS,
        "eval_collected": 0.825,
        "eval_collected_std": 0.071,
        "eval_collected_each": [0.75, 0.9],
        "eval_grasp_success": 0.96,
    },
]


@pytest.fixture
def settings(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["relmm-train"])
    robot, policy = LocobotSimConfig(room="diverse", camera="d435"), ReLMMConfig(device="cpu", camera="d435")
    config = TrainConfig(robot=robot, policy=policy, seed=5, output_dir=tmp_path / "run")
    return json.loads(json.dumps(draccus.encode(config)))


DATASET = UploadedDataset("me/life", "abc123", 9)


def card_of(settings, tmp_path, dataset=DATASET, lines=LINES) -> ModelCard:
    metrics = tmp_path / "metrics.jsonl"
    metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
    facts = ModelFacts("me/cleaner", settings, metrics, dataset, "mit", ("cleaning",))
    return ModelCard(model_card(facts).content)


def test_metadata(settings, tmp_path):
    data = card_of(settings, tmp_path).data
    assert (data.library_name, data.pipeline_tag, data.license) == ("lerobot", "robotics", "mit")
    assert data.datasets == ["me/life"]
    assert {"robotics", "lerobot", "relmm", "cleaning"} <= set(data.tags)


def test_results_are_those_of_the_metrics(settings, tmp_path):
    text = card_of(settings, tmp_path).text
    assert "| 100 | 82.5% ± 7.1% | 75%, 90% | 96.0% |" in text
    assert "each, of seed 1000, 1001" in text
    assert "One training run, of seed 5." in text
    assert "50 |" not in text.split("## Results")[1].split("## Training")[0]
    assert "40 grasp attempts of which 10 succeeded, 7 objects" in text
    assert "in 12 minutes of the robot's time" in text
    assert "![Learning curve" in text


def test_room_camera_and_commands(settings, tmp_path):
    text = card_of(settings, tmp_path).text
    for words in (
        "| room | `diverse` |",
        "| camera | `d435`: 0.4626 m high",
        "[me/life](https://huggingface.co/datasets/me/life), revision `abc123`",
        "relmm-eval --policy.path=me/cleaner --env.room=diverse --env.camera=d435",
        "relmm-train --resume=true --policy.path=me/cleaner",
        "lerobot-rollout --robot.type=locobot_sim --robot.room=diverse --robot.camera=d435 --policy.path=me/cleaner",
    ):
        assert words in text
    commands = text.split("```bash")[1]
    assert commands.index("pip install") < commands.index("relmm-eval"), "the plugin first"


@pytest.mark.parametrize(
    ("kind", "more", "words"),
    [
        ("relmm", {}, "planned over the floor"),
        ("relmm_paper", {}, "soft actor-critic navigates"),
        ("relmm_paper", {"navigation": "random"}, "drives about at random (the paper's baseline Rand nav)"),
        ("relmm_single", {}, "one soft actor-critic decides at every step"),
    ],
)
def test_it_says_how_its_policy_navigates(settings, tmp_path, kind, more, words):
    text = card_of(settings | {"policy": settings["policy"] | {"type": kind} | more}, tmp_path).text
    assert f"A policy `{kind}` that drives" in text
    assert words in text
    assert f"{len(STATE_NAMES)} numbers" in text


def test_what_is_not_there_is_not_claimed(settings, tmp_path):
    card = card_of(settings, tmp_path, dataset=None, lines=[])
    assert card.data.datasets is None
    assert "The run was not evaluated." in card.text
    assert "Its dataset is not shared" in card.text
    assert "--resume=true" not in card.text
    assert "![Learning curve" not in card.text


def test_a_run_on_a_stream_has_no_robot(settings, tmp_path):
    assert "recorded by another process" in card_of(settings | {"robot": None}, tmp_path).text
