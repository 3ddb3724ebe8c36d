"""Where a dataset is that somebody names: a folder, or a repository of the Hub."""

from __future__ import annotations

from pathlib import Path

from relmm.episodes.folder import DATA_FILES, EPISODE_FILES, INFO, RELMM, STATS, TASKS
from relmm.episodes.remote import download, reason
from relmm.episodes.settings import FORMAT_VERSION, check_repo_id
from relmm.errors import ConfigError, DatasetError, HubError

# What a dataset consists of, and the largest sizes that are plausible, in bytes: LeRobot's data files have 100 MB.
_FILES = {
    INFO: 10 << 20,
    STATS: 10 << 20,
    RELMM: 10 << 20,
    TASKS: 10 << 20,
    EPISODE_FILES: 1 << 30,
    DATA_FILES: 1 << 30,
}


def local_root(path_or_repo: str) -> Path:
    """The folder of a dataset, downloaded when it is on the Hub.

    As LeRobot does it: what was recorded under a name on this machine comes before what the Hub has under that name,
    and downloads go to a cache of their own, so that they never overwrite a recording.

    Args:
        path_or_repo: a folder, or `user/name`, or `user/name@revision`. Without a revision it is that of LeRobot's
            format, which `push_to_hub` tags.

    Raises:
        DatasetError: no such folder, a name that the Hub does not allow, or a download that fails.
    """
    folder = Path(path_or_repo).expanduser()
    if path_or_repo and folder.is_dir():
        return folder
    repo_id, _, revision = path_or_repo.partition("@")
    try:
        check_repo_id(repo_id)
    except ConfigError as error:
        raise DatasetError(
            f"there is no folder {path_or_repo!r}, and no dataset of the Hub can have that name; "
            "give the folder of a dataset, or user/name or user/name@revision."
        ) from error
    from lerobot.utils.constants import HF_LEROBOT_HOME

    recorded = HF_LEROBOT_HOME / repo_id
    if not revision and (recorded / INFO).is_file():
        return recorded
    return download_dataset(repo_id, revision or FORMAT_VERSION)


def download_dataset(repo_id: str, revision: str) -> Path:
    """A dataset of the Hub in LeRobot's cache.

    Raises:
        DatasetError: the download fails.
    """
    from lerobot.utils.constants import HF_LEROBOT_HUB_CACHE

    try:
        return download(repo_id, "dataset", revision, _FILES, HF_LEROBOT_HUB_CACHE)
    except HubError as error:
        raise DatasetError(str(error)) from error
    except Exception as error:  # the Hub's client also raises those of its HTTP library, which may change
        why = reason(f"dataset {repo_id}", revision, error)
        raise DatasetError(f"there is no folder {repo_id!r}, and {why}.") from error
