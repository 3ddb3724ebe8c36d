"""The page of a run that goes on, made in a process of its own: `python -m relmm.analysis.page DATASET NAME PAGE`.

It loads neither LeRobot nor torch, which would cost more than the report.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from relmm.analysis.collection import collect
from relmm.analysis.report import REPORT, write_report
from relmm.analysis.summary import summarize_collection
from relmm.errors import RelmmError

_LOWEST_PRIORITY = 19


def write_page(
    root: Path, name: str, page: Path, progress: Callable[[int, int], None] = lambda frames, total: None
) -> None:
    """Write the report of a dataset as one page; nothing else is kept.

    Args:
        root: the dataset, which may be being recorded.
        name: of the dataset, for commands that ask for one.
        page: where to; it is replaced as a whole.
        progress: takes frames read since the last call, and how many there are in all.

    Raises:
        DatasetError: it cannot be read.
        OSError: nor the page be written.
    """
    folder = page.with_name(f".{page.stem}")
    shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed
    try:
        collection = collect(root, folder, progress=progress)
        write_report(folder, collection, summarize_collection(collection, name), files=False)
        os.replace(folder / REPORT, page)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Write the page, without being in anybody's way; ends with a sentence on stderr if that fails."""
    os.nice(_LOWEST_PRIORITY)
    root, name, page = sys.argv[1:]
    try:
        write_page(Path(root), name, Path(page))
    except (RelmmError, OSError, MemoryError) as error:
        sys.exit(str(error) or type(error).__name__)


if __name__ == "__main__":
    main()
