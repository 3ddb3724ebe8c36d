"""From what somebody types to the folder of a dataset."""

import resource
import shutil
import signal
from types import SimpleNamespace

import pytest
from episode_helpers import check_episode, new_dataset

from relmm.episodes import local_root, read_episodes, upload_dataset
from relmm.errors import DatasetError


@pytest.fixture
def home(tmp_path, hub):
    """LeRobot's folder of datasets."""
    return tmp_path / "hf" / "lerobot"


@pytest.fixture
def published(tmp_path, hub):
    """The Hub has one dataset, with more files than one needs."""
    new_dataset(tmp_path / "published", 2)
    upload_dataset(tmp_path / "published", "me/run")
    repo = hub.repo("me/run", "datasets")
    repo.refs["a/b"] = repo.tags["v3.0"] = repo.commit({**repo.files, "movie.mp4": b"0" * 1000})
    hub.requests.clear()
    return hub


def test_a_folder_is_itself(tmp_path, monkeypatch, published):
    (tmp_path / "user" / "name").mkdir(parents=True)
    assert local_root(str(tmp_path)) == tmp_path
    monkeypatch.chdir(tmp_path)
    assert local_root("user/name").samefile(tmp_path / "user" / "name")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert local_root("~/user/name") == tmp_path / "user" / "name"
    assert not published.requests


@pytest.mark.parametrize("name", ["me/run", "me/run@main", "me/run@a/b"])
def test_a_download_goes_to_the_cache_of_lerobot(home, published, name):
    root = local_root(name)
    assert root.is_relative_to(home / "hub" / "datasets--me--run")
    assert [check_episode(episode, number) for number, episode in enumerate(read_episodes(root))] == [None, None]
    files = [path for path in root.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".parquet"}, "what a dataset does not need is left there"


def test_what_is_in_the_cache_needs_no_hub(home, published, fault, monkeypatch):
    root = local_root("me/run")
    published.faults.append(fault("me/run", status=500))
    assert local_root("me/run") == root
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert local_root("me/run") == root


def test_the_tag_is_that_of_lerobot():
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

    from relmm.episodes.settings import FORMAT_VERSION

    assert FORMAT_VERSION == CODEBASE_VERSION


def test_what_was_recorded_here_comes_first(home, published):
    new_dataset(home / "me" / "run", 1)
    assert local_root("me/run") == home / "me" / "run"
    assert not published.requests
    assert local_root("me/run@main").is_relative_to(home / "hub")


@pytest.mark.parametrize(
    "name", ["run", "/nowhere/run", "./runs/first", "a/b/c", "me/bad name", "@main", "me/@main", ""]
)
def test_names_that_are_neither(home, hub, name):
    with pytest.raises(DatasetError, match=r"there is no folder .* user/name@revision") as caught:
        local_root(name)
    assert "\n" not in str(caught.value)
    assert not hub.requests


FAULTS = {
    "401": ({"status": 401}, "does not let you use the dataset me/run.*`hf auth login`"),
    "403": ({"status": 403}, "does not let you use the dataset me/run.*`hf auth login`"),
    "404": ({"status": 404, "headers": {"X-Error-Code": "RepoNotFound"}}, "no dataset me/run.*check the name"),
    "revision": (
        {"status": 404, "headers": {"X-Error-Code": "RevisionNotFound"}},
        r"no revision 'v3\.0'; name another, as in me/run@main",
    ),
    "429": ({"status": 429}, r"too many requests \(429\); try again in some minutes"),
    "500": ({"status": 500}, r"failed \(HfHubHTTPError: .*; try again"),
    "cut": ({"cut": True}, r"failed \(.*; try again"),
}


@pytest.mark.parametrize(("settings", "words"), FAULTS.values(), ids=FAULTS)
@pytest.mark.parametrize("where", ["/api/", "/resolve/"])
def test_downloads_that_fail(home, published, fault, settings, words, where):
    published.faults.append(fault(where, **settings))
    with pytest.raises(DatasetError, match=words if where == "/api/" else "me/run") as caught:
        local_root("me/run")
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")
    published.faults.clear()
    assert len(list(read_episodes(local_root("me/run")))) == 2, "a later download completes"


def test_a_full_disk(home, published, monkeypatch):
    """The disk is full after half of a file."""
    limit = 2000

    def set_limit(size):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_PROGRESS_BARS", True)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond it then fails with EFBIG
    set_limit(limit)
    try:
        with pytest.raises(
            DatasetError, match=r"needs a file that cannot be written .*make room on the disk"
        ) as caught:
            local_root("me/run")
    finally:
        set_limit(soft)
        signal.signal(signal.SIGXFSZ, previous)
    assert "\n" not in str(caught.value)
    assert len(list(read_episodes(local_root("me/run")))) == 2


def test_no_room_is_found_out_before(home, published, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(DatasetError, match="where 0 MB are free; make room"):
        local_root("me/run")
    assert not any("/resolve/" in request for request in published.requests)


HOSTILE = {
    "parent": {"data/../../../evil.parquet": b"x"},
    "absolute": {"/etc/evil": b"x"},
    "drive": {"C:\\evil": b"x"},
}


@pytest.mark.parametrize("files", HOSTILE.values(), ids=HOSTILE)
def test_files_that_leave_their_folder(home, published, tmp_path, files):
    repo = published.repo("me/run", "datasets")
    repo.tags["v3.0"] = repo.commit(repo.files | files)
    with pytest.raises(DatasetError, match="would leave its folder; do not use it"):
        local_root("me/run")
    assert not list(tmp_path.rglob("evil*"))


def test_files_that_are_too_large(home, published):
    repo = published.repo("me/run", "datasets")
    repo.tags["v3.0"] = repo.commit(repo.files | {"meta/info.json": b" " * (11 << 20)})
    with pytest.raises(DatasetError, match=r"meta/info\.json of 12 MB, and at most 10 MB are plausible"):
        local_root("me/run")
    assert not any("/resolve/" in request for request in published.requests)


def test_without_a_connection():
    """The real client: other tests are offline."""
    with pytest.raises(DatasetError, match=r"cannot be reached for the dataset me/run.*HF_HUB_OFFLINE"):
        local_root("me/run")
