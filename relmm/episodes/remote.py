"""Repositories of the Hub: what is taken from them and how a folder gets there, with failures in one sentence.

A repository is untrusted: its list of files is checked before anything is downloaded.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Any

from huggingface_hub import HfApi, hf_hub_download
from huggingface_hub.errors import (
    EntryNotFoundError,
    HfHubHTTPError,
    LocalEntryNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from relmm.episodes.patience import limit_waiting
from relmm.errors import HubError

_PRECONDITION_FAILED = 412
_SPARE_BYTES = 100 << 20  # of the disk, beyond what is downloaded


def reason(repo: str, revision: str, error: Exception) -> str:
    """Why the Hub did not do it and what to do, as the second half of a sentence without its full stop.

    Args:
        repo: what and which, as in `dataset user/name`.
        revision: that was asked for.
        error: of huggingface_hub, or of its HTTP library.
    """
    status = error.response.status_code if isinstance(error, HfHubHTTPError) else 0
    if isinstance(error, RevisionNotFoundError):
        name = repo.split()[-1]
        return f"the {repo} on the Hub has no revision {revision!r}; name another, as in {name}@main"
    if isinstance(error, RepositoryNotFoundError):
        return f"the Hub has no {repo} that you may read; check the name, or `hf auth login` if it is private"
    if status in (401, 403):
        return f"the Hub does not let you use the {repo}; check the name, or `hf auth login` with a token that may"
    if status == _PRECONDITION_FAILED:
        return f"somebody else wrote to the {repo} at the same moment; try again"
    if status == 429:
        return f"the Hub has refused the {repo} because of too many requests (429); try again in some minutes"
    if isinstance(error, LocalEntryNotFoundError | OfflineModeIsEnabled):
        return (
            f"the Hub cannot be reached for the {repo}, of which no copy is on this machine; "
            "check the connection and HF_HUB_OFFLINE, or give a folder"
        )
    if isinstance(error, OSError) and error.strerror and not status:
        return f"the {repo} needs a file that cannot be written ({error.strerror}); make room on the disk and try again"
    said = str(error).strip().split("\n")[0].rstrip(".")
    return f"the transfer of the {repo} has failed ({type(error).__name__}: {said}); try again"


def download(repo_id: str, repo_type: str, revision: str, limits: dict[str, int], cache: Path | None = None) -> Path:
    """Some files of a repository, in a cache of which only huggingface_hub may change something.

    Args:
        repo_id: `user/name`.
        repo_type: `model` or `dataset`.
        revision: a branch, tag or commit.
        limits: which files, by pattern, and how large each may be, in bytes.
        cache: None for that of huggingface_hub.

    Returns:
        A folder of the files.

    Raises:
        HubError: the repository has files that leave their folder or are too large, or the disk is full.
        Exception: of huggingface_hub or its HTTP library; see `reason`.
    """
    from huggingface_hub import constants, snapshot_download

    limit_waiting()

    def snapshot(**where: Any) -> Path:
        patterns = list(limits)
        return Path(snapshot_download(repo_id, repo_type=repo_type, cache_dir=cache, allow_patterns=patterns, **where))

    try:
        info = HfApi().repo_info(repo_id, repo_type=repo_type, revision=revision, files_metadata=True)
    except (RepositoryNotFoundError, RevisionNotFoundError):
        raise
    except Exception as unreachable:  # what is in the cache was checked when it came
        try:
            return snapshot(revision=revision, local_files_only=True)
        except LocalEntryNotFoundError:
            raise unreachable from None
    files = {file.rfilename: file.size or 0 for file in getattr(info, "siblings", None) or []}
    check_listing(f"{repo_type} {repo_id}", files, limits)
    _check_room(Path(cache or constants.HF_HUB_CACHE), _wanted(files, limits))
    return snapshot(revision=revision)


def check_listing(repo: str, files: dict[str, int], limits: dict[str, int]) -> None:
    """Refuse names that leave their folder, and files that are larger than anything relmm writes.

    Args:
        repo: what and which, for the message.
        files: sizes in bytes by name.
        limits: largest sizes by pattern; other files are not downloaded, and may have any size.

    Raises:
        HubError: with the first such file.
    """
    for name, size in files.items():
        parts = PurePosixPath(name).parts
        if name.startswith("/") or "\\" in name or ":" in name or ".." in parts or not parts:
            raise HubError(f"the {repo} lists the file {name!r}, which would leave its folder; do not use it.")
        limit = min((limit for pattern, limit in limits.items() if fnmatch(name, pattern)), default=size)
        if size > limit:
            raise HubError(
                f"the {repo} has a file {name} of {size / 1e6:.0f} MB, and at most {limit / 1e6:.0f} MB are plausible; "
                "use another revision or repository."
            )


def _wanted(files: dict[str, int], limits: dict[str, int]) -> int:
    return sum(size for name, size in files.items() if any(fnmatch(name, pattern) for pattern in limits))


def _check_room(cache: Path, size: int) -> None:
    existing = next(folder for folder in (cache, *cache.resolve().parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    if size + _SPARE_BYTES > free:
        raise HubError(
            f"{size / 1e6:.0f} MB are to be downloaded to {cache}, where {free / 1e6:.0f} MB are free; make room, "
            "or set HF_HOME to a larger disk."
        )


def push_folder(
    folder: Path,
    repo_id: str,
    repo_type: str,
    *,
    private: bool | None,
    replaces: Sequence[str],
    check: Callable[[Callable[[str], Any]], None],
    message: str,
) -> str:
    """Make the files of a folder the newest commit of a repository, which is created if need be.

    Args:
        folder: what to upload.
        repo_id: `user/name`.
        repo_type: `model` or `dataset`.
        private: whether a new repository is; an existing public one is then refused. None for the owner's default.
        replaces: patterns of files that are removed where the folder does not have them; other files stay.
        check: is given a function that reads a JSON file of the repository (None where there is none), and raises
            HubError if its content must not be replaced. Nobody can write between this check and the commit.
        message: of the commit.

    Returns:
        The commit.

    Raises:
        HubError: and nothing has changed but for a new, empty repository.
    """
    limit_waiting()
    api = HfApi()
    try:
        api.create_repo(repo_id, repo_type=repo_type, private=private, exist_ok=True)
        info = api.repo_info(repo_id, repo_type=repo_type)
        if private and info.private is False:
            raise HubError(
                f"the {repo_type} {repo_id} is public, and a private one was asked for; make it private on the Hub, "
                "or choose another name."
            )
        check(lambda name: _remote_json(repo_id, repo_type, str(info.sha), name))
        commit = api.upload_folder(
            repo_id=repo_id,
            repo_type=repo_type,
            folder_path=folder,
            parent_commit=info.sha,
            delete_patterns=list(replaces),
            commit_message=message,
        )
    except HubError:
        raise
    except Exception as error:  # the Hub's client also raises those of its HTTP library, which may change
        raise HubError(f"nothing was uploaded: {reason(f'{repo_type} {repo_id}', 'main', error)}.") from error
    return str(commit.oid)


def _remote_json(repo_id: str, repo_type: str, revision: str, name: str) -> Any:
    try:
        path = hf_hub_download(repo_id, name, repo_type=repo_type, revision=revision)
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except LocalEntryNotFoundError:  # the Hub did not answer: what it has is not known
        raise
    except EntryNotFoundError:
        return None
    except ValueError:
        return {}


def move_tag(repo_id: str, repo_type: str, tag: str, revision: str) -> None:
    """Let a tag name another commit.

    Raises:
        HubError: the Hub cannot be reached or refuses.
    """
    api = HfApi()
    try:
        with contextlib.suppress(RevisionNotFoundError):  # the first upload
            api.delete_tag(repo_id, tag=tag, repo_type=repo_type)
        api.create_tag(repo_id, tag=tag, revision=revision, repo_type=repo_type)
    except Exception as error:  # as above
        why = reason(f"{repo_type} {repo_id}", tag, error)
        raise HubError(f"the files are on the Hub, but without the tag {tag}: {why}.") from error


def reserve(repo_id: str, repo_type: str, private: bool | None, free_of: str | None) -> str:
    """See before a long run that a repository can be written to; it is created if need be.

    Args:
        repo_id: `user/name`.
        repo_type: `model` or `dataset`.
        private: whether a new repository is; None for the owner's default.
        free_of: a file that it must not have, because it would be another run's; None where it may.

    Returns:
        Why that could not be found out now, as a sentence; empty when all is well.

    Raises:
        HubError: uploads would be refused.
    """
    limit_waiting()
    api, repo = HfApi(), f"{repo_type} {repo_id}"
    try:
        api.create_repo(repo_id, repo_type=repo_type, private=private, exist_ok=True)
        taken = free_of is not None and api.file_exists(repo_id, free_of, repo_type=repo_type)
    except Exception as error:  # as above
        why = f"{reason(repo, 'main', error)}."
        if isinstance(error, HfHubHTTPError) and error.response.status_code in (401, 403, 404):
            raise HubError(f"nothing could be uploaded: {why}") from error
        return f"uploads may fail for now: {why}"
    if taken:
        raise HubError(f"the {repo} on the Hub is another run's already; choose another name for this one.")
    return ""
