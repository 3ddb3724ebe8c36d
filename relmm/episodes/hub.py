"""Where a dataset is that somebody names: a folder, or a repository of the Hub."""

from __future__ import annotations

from pathlib import Path

from huggingface_hub.errors import (
    HfHubHTTPError,
    LocalEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from relmm.episodes.folder import INFO
from relmm.episodes.settings import FORMAT_VERSION, check_repo_id
from relmm.errors import ConfigError, DatasetError


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
    return _download(repo_id, revision or FORMAT_VERSION)


def _download(repo_id: str, revision: str) -> Path:
    from huggingface_hub import snapshot_download
    from lerobot.utils.constants import HF_LEROBOT_HUB_CACHE

    try:
        folder = snapshot_download(repo_id, repo_type="dataset", revision=revision, cache_dir=HF_LEROBOT_HUB_CACHE)
    except Exception as error:  # the Hub's client also raises those of its HTTP library, which may change
        raise DatasetError(f"there is no folder {repo_id!r}, and {_reason(repo_id, revision, error)}.") from error
    return Path(folder)


def _reason(repo_id: str, revision: str, error: Exception) -> str:
    if isinstance(error, RevisionNotFoundError):
        return f"the dataset {repo_id} on the Hub has no revision {revision!r}; name another, as in {repo_id}@main"
    refused = isinstance(error, HfHubHTTPError) and error.response.status_code in (401, 403)
    if isinstance(error, RepositoryNotFoundError) or refused:
        return (
            f"the Hub has no dataset {repo_id} that you may read; check the name, or `hf auth login` "
            "if it is private or gated"
        )
    if isinstance(error, LocalEntryNotFoundError):
        return (
            f"the Hub cannot be reached for the dataset {repo_id}, of which no copy is on this machine; "
            "check the connection and HF_HUB_OFFLINE, or give a folder"
        )
    reason = str(error).strip().split("\n")[0].rstrip(".")
    return f"the download of {repo_id} from the Hub has failed ({type(error).__name__}: {reason}); try again"
