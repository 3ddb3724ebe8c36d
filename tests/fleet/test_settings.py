"""What a fleet is told on the command line, and what is refused before anything is reached or written."""

import sys

import pytest

from relmm.commands.fleet import RecordFleetConfig
from relmm.commands.serve import ServeFleetConfig
from relmm.errors import ConfigError
from relmm.fleet.wire import open_channel, read_token, server_credentials


@pytest.mark.parametrize("address", ["somewhere", ":5", "host:", "host:port", "host:70000"])
def test_an_address_is_host_and_port(address):
    with pytest.raises(ConfigError, match=r"fleet.listen is .* but must be HOST:PORT, for example"):
        ServeFleetConfig(listen=address)
    with pytest.raises(ConfigError, match=r"fleet.server is .* but must be HOST:PORT, for example"):
        RecordFleetConfig(server=address)


def test_a_token_without_a_server_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"--fleet.server=HOST:PORT"):
        RecordFleetConfig(token_file=tmp_path / "token")


def test_grpc_is_asked_for_where_it_is_missing(monkeypatch):
    monkeypatch.setattr("relmm.commands.serve.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'lerobot_policy_relmm\[fleet\]'"):
        RecordFleetConfig(server="localhost:5")


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        (None, 0o600, r"token_file .* cannot be read \(No such file"),
        ("0123456789abcdef\n", 0o640, "can be read by others on this machine: say `chmod 600"),
        ("secret", 0o600, "a token of 6 characters, but must have at least 16"),
        ("0123456789abcdeé", 0o600, "letters and digits"),
    ],
)
def test_a_token_that_is_no_secret_is_refused(tmp_path, content, mode, words):
    path = tmp_path / "token"
    if content is not None:
        path.write_text(content)
        path.chmod(mode)
    with pytest.raises(ConfigError, match=words):
        read_token(path)


def test_a_token_is_read_without_its_line_end(tmp_path):
    path = tmp_path / "token"
    path.write_text("0123456789abcdef\n")
    path.chmod(0o600)
    assert read_token(path) == "0123456789abcdef"


def test_files_that_are_missing_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"--fleet.token_file=FILE"):
        read_token(None)
    with pytest.raises(ConfigError, match="A server needs TLS"):
        server_credentials(None, None)
    with pytest.raises(ConfigError, match=r"fleet.key .* cannot be read"):
        server_credentials(tmp_path / "server.pem", tmp_path / "server.key")
    with pytest.raises(ConfigError, match=r"fleet.certificate .* cannot be read"):
        open_channel("localhost:5", "0123456789abcdef", tmp_path / "server.pem")


def test_two_servers_do_not_share_a_folder_or_an_address(serve):
    first = serve()
    with pytest.raises(ConfigError, match="is another relmm-serve's"):
        serve()
    assert first.robots == 0


def test_serving_says_where_and_ends_with_a_signal(tmp_path, monkeypatch, capsys):
    import os
    import signal
    import threading
    from pathlib import Path

    from relmm.commands import serve as module

    here, token = Path(__file__).parent, tmp_path / "token"
    token.write_text("0123456789abcdef")
    token.chmod(0o600)
    options = [f"--dataset.root={tmp_path}/robots", f"--output_dir={tmp_path}/run", "--fleet.listen=localhost:0"]
    files = [f"--fleet.token_file={token}", f"--fleet.certificate={here}/localhost.pem"]
    monkeypatch.setattr(sys, "argv", ["relmm-serve", *options, *files, f"--fleet.key={here}/localhost.key"])
    monkeypatch.setattr(module, "_SHOW_S", 0.05)
    started = []

    def stop_later(*arguments):
        started.append(threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)))
        started[0].start()
        return begin(*arguments)

    from relmm.fleet.server import FleetServer

    begin = FleetServer.start
    monkeypatch.setattr(FleetServer, "start", stop_later)
    module.main()
    assert f"episodes go to {tmp_path}/robots" in capsys.readouterr().out
