"""From what somebody types to the folder of a dataset."""

import httpx
import huggingface_hub
import pytest
from episode_helpers import check_episode, new_dataset
from huggingface_hub.errors import GatedRepoError, HfHubHTTPError, RepositoryNotFoundError, RevisionNotFoundError

from relmm.episodes import local_root, read_episodes
from relmm.errors import DatasetError


@pytest.fixture
def home(tmp_path, monkeypatch):
    """LeRobot's folder of datasets."""
    from lerobot.utils import constants

    monkeypatch.setattr(constants, "HF_LEROBOT_HOME", tmp_path / "lerobot")
    monkeypatch.setattr(constants, "HF_LEROBOT_HUB_CACHE", tmp_path / "lerobot" / "hub")
    return tmp_path / "lerobot"


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """The calls that would have reached the Hub, which has one dataset."""
    calls = []

    def download(repo_id, **arguments):
        calls.append((repo_id, arguments))
        new_dataset(tmp_path / "downloaded", 2)
        return str(tmp_path / "downloaded")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    return calls


def test_a_folder_is_itself(tmp_path, monkeypatch, hub):
    (tmp_path / "user" / "name").mkdir(parents=True)
    assert local_root(str(tmp_path)) == tmp_path
    monkeypatch.chdir(tmp_path)
    assert local_root("user/name").samefile(tmp_path / "user" / "name")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert local_root("~/user/name") == tmp_path / "user" / "name"
    assert hub == []


@pytest.mark.parametrize(("name", "revision"), [("me/run", "v3.0"), ("me/run@main", "main"), ("me/run@a/b", "a/b")])
def test_a_download_goes_to_the_cache_of_lerobot(tmp_path, home, hub, name, revision):
    root = local_root(name)
    assert root == tmp_path / "downloaded"
    assert hub == [("me/run", {"repo_type": "dataset", "revision": revision, "cache_dir": home / "hub"})]
    for number, episode in enumerate(read_episodes(root)):
        check_episode(episode, number)


def test_the_tag_is_that_of_lerobot():
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

    from relmm.episodes.settings import FORMAT_VERSION

    assert FORMAT_VERSION == CODEBASE_VERSION


def test_what_was_recorded_here_comes_first(tmp_path, home, hub):
    new_dataset(home / "me" / "run", 1)
    assert local_root("me/run") == home / "me" / "run"
    assert hub == []
    assert local_root("me/run@main") == tmp_path / "downloaded"


@pytest.mark.parametrize(
    "name", ["run", "/nowhere/run", "./runs/first", "a/b/c", "me/bad name", "@main", "me/@main", ""]
)
def test_names_that_are_neither(home, hub, name):
    with pytest.raises(DatasetError, match=r"there is no folder .* user/name@revision") as caught:
        local_root(name)
    assert "\n" not in str(caught.value)
    assert hub == []


def http_error(kind, status):
    response = httpx.Response(status, request=httpx.Request("GET", "https://huggingface.co"))
    return kind(f"{status} Client Error.\nSecond line.", response=response)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (http_error(RepositoryNotFoundError, 404), "check the name, or `hf auth login`"),
        (http_error(RepositoryNotFoundError, 401), "check the name, or `hf auth login`"),
        (http_error(GatedRepoError, 403), "check the name, or `hf auth login`"),
        (http_error(HfHubHTTPError, 401), "check the name, or `hf auth login`"),
        (http_error(RevisionNotFoundError, 404), r"no revision 'v3\.0'; name another, as in me/run@main"),
        (http_error(HfHubHTTPError, 500), r"failed \(HfHubHTTPError: 500 Client Error\); try again"),
        (httpx.ReadTimeout("timed out"), r"failed \(ReadTimeout: timed out\); try again"),
        (OSError(28, "No space left on device"), "No space left on device"),
    ],
)
def test_downloads_that_fail(home, monkeypatch, error, words):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fail)
    with pytest.raises(DatasetError, match=words) as caught:
        local_root("me/run")
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")


def test_without_a_connection(home):
    """The real client: the tests are offline."""
    with pytest.raises(DatasetError, match=r"cannot be reached for the dataset me/run.*HF_HUB_OFFLINE"):
        local_root("me/run")
