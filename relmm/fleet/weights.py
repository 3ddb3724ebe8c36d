"""The folder of a policy as bytes and back: JSON and safetensors only, checked like a policy from the Hub."""

from __future__ import annotations

import hashlib
import os
import shutil
from fnmatch import fnmatch
from pathlib import Path

from relmm.errors import ConfigError, FleetError
from relmm.fleet.wire import MAX_WEIGHTS_BYTES, pack, text, unpack
from relmm.learning.hub import POLICY_FILES
from relmm.learning.settings import SETTINGS
from relmm.learning.untrusted import CONFIG, WEIGHTS, check_features, check_policy_folder, check_weights

_MODEL, _LAST = "pretrained_model", "last"


class NewestWeights:
    """The newest checkpoint of a run, as it is sent.

    Args:
        checkpoints: of the run; there need not be any yet.

    Attributes:
        digest: SHA-256 of the content, empty while there is none.
        content: see `pack_policy`.
    """

    def __init__(self, checkpoints: Path) -> None:
        self._last = checkpoints / _LAST / _MODEL
        self._read: tuple[Path, int] | None = None
        self.digest, self.content = "", b""

    def look(self) -> None:
        """See whether there is a newer one; what is being replaced just now is left for the next time."""
        folder = self._last.resolve()
        try:
            found = folder, (folder / WEIGHTS).stat().st_ino
            if found == self._read:
                return
            content = pack_policy(folder)
        except OSError:
            return
        self._read, self.content, self.digest = found, content, hashlib.sha256(content).hexdigest()


def pack_policy(folder: Path) -> bytes:
    """A policy as bytes, without the settings of its run.

    Args:
        folder: `checkpoints/<step>/pretrained_model`.
    """
    names = [path.name for path in sorted(folder.iterdir()) if path.name != SETTINGS and _limit(path.name)]
    contents = [(folder / name).read_bytes() for name in names]
    files = [[name, len(content)] for name, content in zip(names, contents, strict=True)]
    return pack({"step": folder.parent.name, "files": files}, b"".join(contents))


def unpack_policy(content: bytes, target: Path) -> Path:
    """Make the policy the newest in a folder that is laid out as `checkpoints`; older ones are removed.

    Args:
        content: of `pack_policy`, from a server.
        target: the folder.

    Returns:
        What `--policy.path` takes; it leads to the newest at any time.

    Raises:
        FleetError: it is not what `pack_policy` makes, or no policy of relmm.
    """
    header, body = unpack(content)
    step, files = text(header, "step"), header.get("files")
    if not step.isdecimal() or not step.isascii() or not isinstance(files, list):
        raise FleetError("the server's weights are of no checkpoint; use the same version of relmm on both sides.")
    folder = target / f".{step}.tmp"
    shutil.rmtree(folder, ignore_errors=True)
    (folder / _MODEL).mkdir(parents=True)
    try:
        _write_files(files, body, folder / _MODEL)
        _check(folder / _MODEL)
    except (ConfigError, TypeError, ValueError) as error:
        shutil.rmtree(folder)
        raise FleetError(f"the server's weights cannot be used: {error}") from error
    shutil.rmtree(target / step, ignore_errors=True)
    os.replace(folder, target / step)
    _link(target / _LAST, step)
    for other in target.iterdir():
        if other.name not in (step, _LAST):
            shutil.rmtree(other, ignore_errors=True)
    return target / _LAST / _MODEL


def _limit(name: str) -> int:
    """The largest plausible size of a policy's file, bytes; 0 for what is none of its files."""
    return next((limit for pattern, limit in POLICY_FILES.items() if fnmatch(name, pattern)), 0)


def _write_files(files: list[object], body: bytes, folder: Path) -> None:
    start = 0
    for entry in files:
        name, size = entry if isinstance(entry, list) and len(entry) == 2 else ("", 0)
        limit = _limit(name) if isinstance(name, str) and "/" not in name and name != SETTINGS else 0
        if type(size) is not int or not 0 < size <= limit:
            raise ValueError(f"it has a file {str(name)[:50]!r}, which no policy has.")
        (folder / name).write_bytes(body[start : start + size])
        start += size
    if start != len(body) or start > MAX_WEIGHTS_BYTES:
        raise ValueError("its files are not as long as it says.")


def _check(folder: Path) -> None:
    from lerobot.configs.policies import PreTrainedConfig

    check_policy_folder(folder)
    try:
        config = PreTrainedConfig.from_pretrained(folder)
    except Exception as error:  # draccus and LeRobot refuse what does not fit with errors of any kind
        raise ConfigError(f"{folder / CONFIG} cannot be read ({' '.join(str(error).split())}).") from error
    check_features(config, folder)
    check_weights(config, folder)


def _link(link: Path, target: str) -> None:
    temporary = link.with_name(f".{link.name}.tmp")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    os.replace(temporary, link)
