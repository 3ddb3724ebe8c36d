"""Uploads of a run: in the background while it goes on, and a last one when it has ended.

Each is a `relmm-upload` in a process of its own, so that nothing it meets can slow or end the run.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

from relmm.commands.train_config import TrainConfig
from relmm.episodes.folder import INFO
from relmm.episodes.remote import reserve
from relmm.errors import HubError
from relmm.learning.untrusted import CONFIG


class Uploads:
    """Uploads of one run.

    Args:
        arguments: of relmm-upload; none to upload nothing.
        folder: where everything is kept, for messages.
        say: prints a line.
    """

    def __init__(self, arguments: list[str], folder: Path, say: Callable[[str], None] = print) -> None:
        self.say = say
        self._arguments, self._folder = arguments, folder
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None

    def begin(self) -> None:
        """Upload in the background what is there now, unless the last upload is still under way."""
        self.check()
        if not self._arguments:
            return
        if self._process is not None:
            self.say("upload: the last one is still under way; the next one takes what is new by then.")
            return
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed in `check`
        # In a session of its own, where a Ctrl-C that is meant for the run does not reach it.
        self._process = subprocess.Popen(
            _command([*self._arguments, "--background=true"]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env=_environment(),
            start_new_session=True,
        )

    def check(self) -> None:
        """Say it if an upload has failed since."""
        if self._process is None or self._process.poll() is None:
            return
        assert self._errors is not None
        self._errors.seek(0)
        if self._process.returncode != 0:
            self.say(f"upload: {_last_line(self._errors.read())} The run goes on; the next upload tries again.")
        self._errors.close()
        self._process = self._errors = None

    def finish(self) -> None:
        """Upload what there is, and wait for it.

        Raises:
            HubError: it has failed; everything is on this machine.
        """
        if not self._arguments:
            return
        self._stop()
        command = shlex.join(["relmm-upload", *self._arguments])
        later = f"Everything is saved in {self._folder}; upload it later with: {command}"
        self.say("Uploading to the Hub; Ctrl-C leaves it for later.")
        try:
            result = subprocess.run(
                _command(self._arguments),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                env=_environment(),
                check=False,
            )
        except KeyboardInterrupt:
            raise HubError(f"the upload was stopped. {later}") from None
        if result.returncode != 0:
            raise HubError(f"{_last_line(result.stderr)} {later}")
        self.say(result.stdout.decode().strip())

    def _stop(self) -> None:
        """End an upload in the background: what it would have sent is in the last one."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
            self._process = None


def _command(arguments: list[str]) -> list[str]:
    return [sys.executable, "-m", "relmm.commands.upload", *arguments]


def _environment() -> dict[str, str]:
    return {**os.environ, "HF_HUB_DISABLE_PROGRESS_BARS": "1", "OMP_NUM_THREADS": "1"}


def _last_line(errors: bytes) -> str:
    lines = errors.decode(errors="replace").strip().splitlines() or ["it has ended without a word."]
    return lines[-1].removeprefix("relmm-upload: ")


def _options(**values: object) -> list[str]:
    given = {name.replace("__", "."): value for name, value in values.items() if value is not None}
    return [f"--{name}={str(value).lower() if isinstance(value, bool) else value}" for name, value in given.items()]


def dataset_arguments(repo_id: str, root: Path | None, private: bool | None, license: str) -> list[str]:
    """Arguments of relmm-upload for a dataset."""
    return _options(dataset__repo_id=repo_id, dataset__root=root, dataset__private=private, dataset__license=license)


def run_arguments(config: TrainConfig) -> list[str]:
    """Arguments of relmm-upload for what a run of relmm-train is asked to upload; none if nothing."""
    policy, dataset = config.policy, config.dataset
    assert policy is not None
    arguments = []
    if policy.push_to_hub:
        arguments += _options(
            policy__repo_id=policy.repo_id, policy__private=policy.private, policy__license=policy.license
        )
        arguments += [f"--policy.tags=[{','.join(policy.tags)}]"] if policy.tags else []
    if dataset.push_to_hub:
        arguments += dataset_arguments(dataset.repo_id, dataset.root, dataset.private, dataset.license)
    return [*_options(output_dir=config.output_dir), *arguments] if arguments else []


def check_uploads(config: TrainConfig) -> None:
    """See before anything moves that what is asked to be uploaded can be.

    Raises:
        HubError: the Hub refuses; where it cannot be reached, that is only said.
    """
    assert config.policy is not None
    if config.policy.push_to_hub:
        _check(str(config.policy.repo_id), "model", config.policy.private, None if config.resume else CONFIG)
    if config.dataset.push_to_hub:
        check_dataset_upload(config.dataset.repo_id, config.dataset.private, config.resume)


def check_dataset_upload(repo_id: str, private: bool | None, resume: bool) -> None:
    """As `check_uploads`, of a dataset."""
    _check(repo_id, "dataset", private, None if resume else INFO)


def _check(repo_id: str, repo_type: str, private: bool | None, free_of: str | None) -> None:
    problem = reserve(repo_id, repo_type, private, free_of)
    if problem:
        print(problem, file=sys.stderr)
