"""`--wandb.enable=true`: what was logged is read back from the files that W&B keeps of an offline run."""

import json
from pathlib import Path

import pytest
from lerobot.configs.default import WandBConfig

from relmm.commands.tracking import Tracker, check_tracking
from relmm.commands.train_config import TrainConfig
from relmm.commands.training_run import settings_to_keep
from relmm.errors import ConfigError
from relmm.learning.settings import portable_settings
from relmm.sim.config_locobot_sim import LocobotSimConfig

OFFLINE = WandBConfig(enable=True, mode="offline")


def logged(folder: Path) -> list[dict]:
    """The lines of every run in a folder, oldest first."""
    from wandb.proto import wandb_internal_pb2
    from wandb.sdk.internal.datastore import DataStore

    lines = []
    for file in sorted(folder.glob("wandb/offline-run-*/run-*.wandb")):
        store = DataStore()
        store.open_for_scan(str(file))
        while (data := store.scan_data()) is not None:
            record = wandb_internal_pb2.Record()
            record.ParseFromString(data)
            if record.WhichOneof("record_type") == "history":
                items = record.history.item
                lines.append({item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items})
    return lines


def run_in(folder: Path, resume: bool = False) -> TrainConfig:
    return TrainConfig(robot=LocobotSimConfig(), output_dir=folder, wandb=WandBConfig(**vars(OFFLINE)), resume=resume)


def ids(folder: Path) -> set[str]:
    return {file.stem.removeprefix("run-") for file in folder.glob("wandb/offline-run-*/run-*.wandb")}


@pytest.mark.slow
def test_metrics_and_scores_are_logged_by_navigation_steps_and_a_resumed_run_is_the_same_run(tmp_path, capsys):
    config = run_in(tmp_path / "run")
    tracker = Tracker(config, settings_to_keep(config))
    tracker.log({"steps": 0, "attempts": 10, "grasp_loss": 0.5})
    tracker.log({"steps": 50, "eval_collected": 0.75, "eval_collected_each": [0.5, 1.0]})
    tracker.finish()
    assert "wandb sync" in capsys.readouterr().out
    config = run_in(tmp_path / "run", resume=True)
    tracker = Tracker(config, settings_to_keep(config))
    tracker.log({"steps": 60, "attempts": 12, "grasp_loss": 0.25})
    tracker.finish()
    assert len(ids(tmp_path / "run")) == 1
    lines = [{name: line[name] for name in line if not name.startswith("_")} for line in logged(tmp_path / "run")]
    assert lines == [
        {"train/steps": 0, "train/attempts": 10, "train/grasp_loss": 0.5},
        {"eval/steps": 50, "eval/collected": 0.75},
        {"train/steps": 60, "train/attempts": 12, "train/grasp_loss": 0.25},
    ]


def test_a_tracker_that_fails_is_said_once_and_ends_no_run(caplog):
    tracker = Tracker.__new__(Tracker)
    tracker._lost, calls = False, []

    def fail(*_, **__):
        calls.append(1)
        raise RuntimeError("the service is gone")

    tracker._logger = type("Logger", (), {"log_dict": fail})()
    for step in (50, 100):
        tracker.log({"steps": step, "grasp_loss": 0.5})
    assert len(calls) == len(caplog.messages) == 1
    assert "the service is gone" in caplog.text


def test_without_an_account_it_says_what_to_do(monkeypatch):
    import wandb

    monkeypatch.setattr(type(wandb.api), "api_key", None)
    with pytest.raises(ConfigError, match="wandb login"):
        check_tracking(WandBConfig(enable=True))
    check_tracking(WandBConfig())
    check_tracking(OFFLINE)
    with pytest.raises(ConfigError, match="online, offline, disabled"):
        check_tracking(WandBConfig(mode="ofline"))


def test_a_run_of_somebody_else_does_not_track_here(tmp_path):
    """Nor does a checkpoint on the Hub tell whose account its run was tracked with."""
    settings = settings_to_keep(run_in(tmp_path / "run"))
    assert settings["wandb"]["enable"]  # a run of this machine goes on as it was
    assert "wandb" not in portable_settings(settings)
