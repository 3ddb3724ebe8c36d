"""Which policy relmm-train trains: one that the command line names, one of a file of settings, or the default."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from draccus.cfgparsing import load_config
from draccus.utils import ParsingError

from relmm.commands.arguments import Arguments
from relmm.errors import ConfigError
from relmm.learning.untrusted import refuse_first_version


def choose_policy(arguments: Arguments) -> None:
    """Take `--policy.type=relmm` where nothing else names a policy.

    Args:
        arguments: of the command line; changed in place.

    Raises:
        ConfigError: the file of settings is of another policy than the command line says, or of relmm 0.1.0.
    """
    said, path, file = (arguments.get(name) for name in ("policy.type", "policy.path", "config_path"))
    stored = {} if file is None else _stored_policy(Path(file))
    refuse_first_version(stored, Path(file or ""))
    if said is not None and stored.get("type", said) != said:
        raise ConfigError(
            f"--policy.type={said} and --config_path={file}, which is of policy {stored['type']!r}: leave one of "
            "them out."
        )
    if said is None and path is None and not {"type", "path"} & stored.keys():
        arguments.set("policy.type", "relmm")


def _stored_policy(file: Path) -> dict[str, Any]:
    """The policy's settings in a file; none if it cannot be read, which the parser says better."""
    try:
        with file.open(encoding="utf-8") as stream:
            settings = load_config(stream, file=file)
    except (OSError, ParsingError):
        return {}
    policy = settings.get("policy") if isinstance(settings, dict) else None
    return policy if isinstance(policy, dict) else {}
