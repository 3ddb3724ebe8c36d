"""`--display_data` of the commands; in this process, because importing LeRobot takes seconds."""

import importlib.util
import sys

import pytest
from rerun.experimental import RrdReader

from relmm.commands import display, evaluate, train
from relmm.commands.display import DisplayOptions
from relmm.commands.evaluate import EvalConfig, EvalSettings
from relmm.commands.train_config import TrainConfig
from relmm.commands.training_run import settings_to_keep
from relmm.errors import ConfigError
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.config_relmm_room import RelmmRoomEnvConfig


@pytest.fixture
def no_screen(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"display_data": True}, "no screen here to display on: say --display_path=FILE.rrd"),
        ({"display_path": "life.rrd"}, "need --display_data=true"),
        ({"display_data": True, "display_ip": "10.0.0.2"}, "--display_port=PORT"),
        ({"display_data": True, "display_path": "life.mp4"}, "files that end in .rrd"),
        ({"display_data": True, "display_path": "there.rrd"}, "exists already"),
        ({"display_data": True, "display_path": "a.rrd", "display_ip": "::1", "display_port": 9876}, "Choose one"),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(tmp_path, monkeypatch, no_screen, options, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.rrd").touch()
    if "display_path" in options:
        options = {**options, "display_path": tmp_path / options["display_path"]}
    with pytest.raises(ConfigError, match=words):
        DisplayOptions(**options).check_display()


def test_a_viewer_elsewhere_needs_no_screen(no_screen):
    DisplayOptions(display_data=True, display_ip="10.0.0.2", display_port=9876).check_display()


def test_without_rerun_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(display, "find_spec", lambda name: None if name == "rerun" else importlib.util.find_spec(name))
    with pytest.raises(ConfigError, match=r"pip install 'lerobot_policy_relmm\[viz\]'"):
        DisplayOptions(display_data=True).check_display()


def test_where_no_robot_is_nothing_can_be_displayed(monkeypatch, capsys, tmp_path):
    arguments = [f"--dataset.follow={tmp_path}", "--display_data=true", f"--output_dir={tmp_path / 'run'}"]
    monkeypatch.setattr(sys, "argv", ["relmm-train", *arguments])
    with pytest.raises(SystemExit):
        train.main()
    assert "There is no robot here to display" in capsys.readouterr().err


def test_who_looks_on_today_need_not_after_a_resume(tmp_path):
    options = {"display_data": True, "display_path": tmp_path / "life.rrd"}
    config = TrainConfig(robot=LocobotSimConfig(), output_dir=tmp_path / "run", **options)
    assert not any(name.startswith("display") for name in settings_to_keep(config))


def test_evaluation_is_written_to_a_file(tmp_path):
    """Every step of both episodes is in it, and the second one begins where it stands."""
    path = tmp_path / "shown" / "eval.rrd"
    config = EvalConfig(
        env=RelmmRoomEnvConfig(navigation_steps=3),
        policy=RelmmScriptedConfig(),
        eval=EvalSettings(n_episodes=2, n_videos=0),
        output_dir=tmp_path / "out",
        display_data=True,
        display_path=path,
    )
    evaluate.evaluate(config)
    chunks = [(str(c.entity_path), c.to_record_batch()) for c in RrdReader(path).store().stream().to_chunks()]
    frames = {place: [] for place in ("/camera", "/where/track")}
    for place, batch in chunks:
        if place in frames:
            frames[place] += batch["frame"].to_pylist()
    assert sorted(frames["/camera"]) == sorted(frames["/where/track"]) == list(range(len(frames["/camera"])))
    assert len(frames["/camera"]) >= 6
    tracks = [batch["LineStrips2D:strips"].to_pylist() for place, batch in chunks if place == "/where/track"]
    beginnings = [track for batch in tracks for (track,) in batch if len(track) == 1]
    assert beginnings == [[[0.0, 0.0]]] * 2
