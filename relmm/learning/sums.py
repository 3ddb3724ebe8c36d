"""Check sums of a folder of a checkpoint, in the format of `sha256sum -c`, so that a flipped bit is noticed."""

from __future__ import annotations

import hashlib
from pathlib import Path

from relmm.errors import ConfigError

SUMS = "SHA256SUMS"
_MAX_BYTES = 1 << 20


def write_sums(folder: Path, leave_out: tuple[str, ...] = ()) -> None:
    """Write down the check sums of all files of a folder.

    Args:
        folder: whose files are complete.
        leave_out: names of files that may change.
    """
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    lines = [f"{_digest(folder / name)}  {name}\n" for name in names if name not in {SUMS, *leave_out}]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")


def check_sums(folder: Path) -> None:
    """Refuse a folder with a file that has changed since `write_sums`; one without check sums is not checked.

    Raises:
        ConfigError: with the first such file.
    """
    path = folder / SUMS
    if not path.is_file():
        return
    own = {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}
    lines = path.read_bytes().decode(errors="replace").splitlines() if path.stat().st_size <= _MAX_BYTES else ["?"]
    for line in lines:
        digest, _, name = line.partition("  ")
        if name not in own or _digest(folder / name) != digest:
            raise ConfigError(
                f"{folder} is damaged: {name[:100]!r} is not what {SUMS} says; use another checkpoint, or download it "
                f"again (or remove {SUMS}, if you have changed the file yourself)."
            )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
