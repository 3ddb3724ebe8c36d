"""Uploads of a run: in the background while it goes on, and a last one when it has ended.

Each is a `relmm-upload` in a process of its own, so that nothing it meets can slow or end the run.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from relmm.commands.background import BackgroundCommand, last_line
from relmm.commands.train_config import TrainConfig
from relmm.episodes.folder import INFO
from relmm.episodes.remote import reserve
from relmm.errors import HubError
from relmm.learning.untrusted import CONFIG

_MODULE, _PREFIX = "relmm.commands.upload", "relmm-upload: "
_QUIET = {"HF_HUB_DISABLE_PROGRESS_BARS": "1", "OMP_NUM_THREADS": "1"}


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
        self._upload: BackgroundCommand | None = None

    def begin(self) -> None:
        """Upload in the background what is there now, unless the last upload is still under way."""
        self.check()
        if not self._arguments:
            return
        if self._upload is not None:
            self.say("upload: the last one is still under way; the next one takes what is new by then.")
            return
        self._upload = BackgroundCommand([_MODULE, *self._arguments, "--background=true"], **_QUIET)

    def check(self) -> None:
        """Say it if an upload has failed since."""
        if self._upload is None or self._upload.running:
            return
        if problem := self._upload.problem():
            self.say(f"upload: {problem.removeprefix(_PREFIX)} The run goes on; the next upload tries again.")
        self._upload = None

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
                [sys.executable, "-m", _MODULE, *self._arguments],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                env={**os.environ, **_QUIET},
                check=False,
            )
        except KeyboardInterrupt:
            raise HubError(f"the upload was stopped. {later}") from None
        if result.returncode != 0:
            raise HubError(f"{last_line(result.stderr).removeprefix(_PREFIX)} {later}")
        self.say(result.stdout.decode().strip())

    def _stop(self) -> None:
        """End an upload in the background: what it would have sent is in the last one."""
        if self._upload is not None:
            self._upload.stop()
            self._upload = None


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
