"""Uploading a dataset: what is durable of it, in files of LeRobot's usual sizes, with a card and LeRobot's tag."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from relmm.episodes.card import CONTACT_SHEET, dataset_card
from relmm.episodes.compact import compact
from relmm.episodes.contact_sheet import draw_contact_sheet
from relmm.episodes.folder import INFO, RELMM, DatasetFolder
from relmm.episodes.info import runs_of
from relmm.episodes.remote import move_tag, push_folder
from relmm.episodes.settings import FORMAT_VERSION, check_repo_id, check_trainable
from relmm.errors import DatasetError, HubError


@dataclass(frozen=True)
class UploadedDataset:
    """A dataset on the Hub.

    Attributes:
        repo_id: its name, `user/name`.
        revision: the commit.
        episodes: that it holds there.
    """

    repo_id: str
    revision: str
    episodes: int


def upload_dataset(
    root: Path | str, repo_id: str, *, private: bool | None = None, license: str = "apache-2.0"
) -> UploadedDataset:
    """Upload the whole episodes of a dataset, which may be being recorded and is not changed.

    Args:
        root: a dataset that relmm can train on.
        repo_id: its name on the Hub, `user/name`.
        private: whether a new repository is private; None for the owner's default.
        license: for the card, an identifier of the Hub.

    Raises:
        ConfigError: the Hub would refuse the name.
        DatasetError: no dataset, no whole episode yet, or no room for the copy that is uploaded.
        HubError: the upload has failed, or the repository holds another dataset.
    """
    check_repo_id(repo_id)
    check_trainable(root)
    with tempfile.TemporaryDirectory(prefix="relmm-upload-") as temporary:
        folder = DatasetFolder(Path(temporary) / "dataset")
        try:
            episodes = compact(root, folder.root)
            sheet = draw_contact_sheet(folder.root, folder.root / CONTACT_SHEET, episodes)
            dataset_card(folder, repo_id, license, sheet).save(folder.root / "README.md")
        except OSError as error:
            raise DatasetError(
                f"the copy of {root} that is uploaded cannot be written to {temporary} ({error.strerror or error}); "
                "make room there, or set TMPDIR to a larger disk."
            ) from error
        revision = push_folder(
            folder.root,
            repo_id,
            "dataset",
            private=private,
            replaces=["data/*", "meta/*", CONTACT_SHEET],
            check=_refuse_others(folder, repo_id, episodes),
            message=f"{episodes} episodes",
        )
    move_tag(repo_id, "dataset", FORMAT_VERSION, revision)
    return UploadedDataset(repo_id, revision, episodes)


def _refuse_others(folder: DatasetFolder, repo_id: str, episodes: int) -> Callable[[Callable[[str], Any]], None]:
    """A check that a repository has nothing, or an earlier state of this dataset."""
    own = recorded_runs(folder)

    def check(read: Callable[[str], Any]) -> None:
        info, relmm = read(INFO), read(RELMM)
        if info is None:
            return
        theirs, there = runs_of(relmm), info.get("total_episodes") if isinstance(info, dict) else None
        refuse_other_runs(f"dataset {repo_id}", own, theirs)
        if not isinstance(there, int) or there > episodes:
            raise HubError(
                f"the dataset {repo_id} on the Hub has {there} episodes and this one {episodes}, so somebody else goes "
                "on with it; choose another name for this one."
            )

    return check


def refuse_other_runs(repo: str, own: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> None:
    """Refuse to replace what comes from other runs, or from these and later ones.

    Args:
        repo: what and which, for the message.
        own: runs of what is to be uploaded; see `recorded_runs`.
        theirs: runs of what is on the Hub.

    Raises:
        HubError: own does not go on from theirs.
    """
    if theirs == own[: len(theirs)] and bool(theirs) == bool(own):
        return
    if own and own == theirs[: len(own)]:
        what = "goes on from this one, so somebody else works with it"
    else:
        what = "comes from another run"
    raise HubError(f"the {repo} on the Hub {what}; choose another name for this one.")


def recorded_runs(folder: DatasetFolder) -> list[dict[str, Any]]:
    """With what a dataset was recorded, run by run; equal beginnings mean the same dataset."""
    return runs_of(folder.read_json(RELMM))
