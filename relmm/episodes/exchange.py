"""Folders of a dataset replaced by others, so that a kill at any instant leaves the old ones or the new ones.

Linux exchanges two names in one call, and several folders in one call each. What is between these calls is written
down before the first, and finished by whoever opens the dataset next.
"""

from __future__ import annotations

import ctypes
import json
import os
from pathlib import Path

from relmm.episodes.folder import DatasetFolder, sync

_NAME = "exchange"  # below the scratch folder
_READY = "ready.json"
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def exchange_folder(folder: DatasetFolder) -> Path:
    """Where the new folders are made, below names as in the dataset."""
    return folder.scratch / _NAME


def exchange_folders(folder: DatasetFolder, names: list[str]) -> None:
    """Put the folders that are ready in `exchange_folder` into the dataset, and remove those that were there.

    Raises:
        OSError: the system or file system cannot exchange names; nothing has changed then.
    """
    source = exchange_folder(folder)
    for path in source.rglob("*"):
        sync(path)
    places = {name: (source / name).stat().st_ino for name in names}
    temporary = source / f".{_READY}"
    temporary.write_text(json.dumps(places), encoding="utf-8")
    sync(temporary)
    os.replace(temporary, source / _READY)
    sync(source)
    finish_exchange(folder)


def finish_exchange(folder: DatasetFolder) -> None:
    """Go on with an exchange that was killed, if there was one."""
    source = exchange_folder(folder)
    ready = source / _READY
    if not ready.is_file():
        return
    exchanged: list[str] = []
    try:
        for name, inode in json.loads(ready.read_text(encoding="utf-8")).items():
            if (folder.root / name).stat().st_ino != inode:
                _exchange(source / name, folder.root / name)
                sync((folder.root / name).parent)
            exchanged.append(name)
    except OSError:
        for name in exchanged:  # all or none
            _exchange(source / name, folder.root / name)
        raise
    finally:
        ready.unlink()
        sync(source)


def _exchange(first: Path, second: Path) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):  # not Linux
        raise OSError("this system cannot exchange two folders")
    if libc.renameat2(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), _RENAME_EXCHANGE):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
