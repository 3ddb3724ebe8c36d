"""Weights come back from the learner, checked as those from the Hub are."""

import shutil

import pytest

from relmm.errors import FleetError
from relmm.fleet.client import Link, fetch_weights
from relmm.fleet.wire import pack

NAME = "me/d"


def test_weights_come_with_all_that_a_policy_needs_and_nothing_else(serve, connect, run, tmp_path, monkeypatch):
    monkeypatch.setattr("relmm.fleet.server.CHUNK_BYTES", 10_000)
    assert fetch_weights(connect(serve()), tmp_path / "here")
    here = tmp_path / "here" / "last" / "pretrained_model"
    there = run / "last" / "pretrained_model"
    assert {path.name for path in here.iterdir()} == {path.name for path in there.iterdir()} - {"train_config.json"}
    assert all((here / path.name).read_bytes() == path.read_bytes() for path in here.iterdir())
    assert here.resolve().parent.name == "000007"


def test_no_weights_yet_is_no_error(serve, connect, tmp_path):
    assert fetch_weights(connect(serve()), tmp_path / "here") == ""


def test_a_robot_gets_newer_weights_when_there_are_some(serve, connect, robot, run, policy, tmp_path, monkeypatch):
    monkeypatch.setattr("relmm.fleet.server._LOOK_S", 0.0)
    monkeypatch.setattr("relmm.fleet.client._HEARTBEAT_S", 0.0)
    link = Link(connect(serve()), robot, NAME, tmp_path / "here")
    link.sync()
    assert (tmp_path / "here" / "last").resolve().name == "000007"
    newer = shutil.copytree(policy, run / "000009") / "pretrained_model"
    (newer / "config.json").write_text((newer / "config.json").read_text() + "\n")
    (newer / "SHA256SUMS").unlink()
    (run / "last").unlink()
    (run / "last").symlink_to("000009")
    link.sync()
    assert [path.name for path in sorted((tmp_path / "here").iterdir())] == ["000009", "last"]
    assert (tmp_path / "here" / "last").resolve().name == "000009"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("model.safetensors", b"\x80\x04N."),
        ("config.json", b'{"type": "act"}'),
        ("policy_preprocessor.json", b'{"steps": [{"class": "os.system"}]}'),
        ("evil.pkl", b"\x80\x04N."),
        ("../evil.json", b"{}"),
    ],
)
def test_weights_that_the_hub_checks_refuse_are_not_installed(policy, tmp_path, name, content):
    from relmm.fleet.weights import unpack_policy

    files = {path.name: path.read_bytes() for path in (policy / "pretrained_model").iterdir() if path.suffix != ".txt"}
    files = {key: value for key, value in files.items() if key not in ("SHA256SUMS", "train_config.json")}
    files[name] = content
    blob = pack(
        {"step": "000007", "files": [[key, len(value)] for key, value in files.items()]}, b"".join(files.values())
    )
    with pytest.raises(FleetError, match="the server's weights cannot be used"):
        unpack_policy(blob, tmp_path / "here")
    assert not list((tmp_path / "here").iterdir())
