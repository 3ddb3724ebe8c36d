"""A long life in a few files."""

import errno
import os
import signal

import pytest
from episode_children import die_while_packing
from episode_helpers import REPO_ID, check_dataset, check_episodes, load, new_dataset, record

from relmm.episodes import DurableDataset, EpisodeFollower, compact, exchange, read_episodes, verify_and_repair

FILES = ("data/*/*.parquet", "meta/episodes/*/*.parquet")


@pytest.fixture
def many(monkeypatch) -> None:
    monkeypatch.setattr(compact, "_MANY_FILES", 3)


def count(root) -> list[int]:
    return [len(list(root.glob(pattern))) for pattern in FILES]


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize("depth", [False, True])
def test_many_small_files_become_one_when_a_recording_ends_or_goes_on(tmp_path, depth) -> None:
    root = tmp_path / "d"
    new_dataset(root, 3, depth)
    assert count(root) == [3, 3], "not many yet"
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(3, 5), depth)
        assert count(root) == [5, 5]
    assert count(root) == [1, 1]
    check_dataset(root, 5, depth)
    assert not (root / "images").exists()
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(5, 7), depth)
    assert count(root) == [3, 3]
    check_dataset(root, 7, depth)
    assert verify_and_repair(root).problems == []


@pytest.mark.parametrize("done", [-1, 0, 1, 2])
def test_killed_while_files_are_exchanged(tmp_path, forkserver, done) -> None:
    root = tmp_path / "d"
    new_dataset(root, 5)
    process = forkserver.Process(target=die_while_packing, args=(root, done))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert count(root)[0] == (1 if done > 0 else 5)
    stock = load(root)  # as it is, without a repair
    assert stock.num_episodes == 5
    assert stock.hf_dataset["episode_index"][0] == 0
    assert len(stock) == len(stock.hf_dataset)
    with DurableDataset.open(root, REPO_ID) as dataset:
        assert dataset.repaired.problems == []
        record(dataset, range(5, 6))
    check_dataset(root, 6)
    assert not (root / "images").exists()


@pytest.mark.usefixtures("many")
def test_who_follows_misses_nothing_when_files_are_exchanged(tmp_path) -> None:
    root = tmp_path / "d"
    new_dataset(root, 2)
    follower = EpisodeFollower(root)
    check_episodes(follower.poll(), range(2))
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(2, 4))
        check_episodes(follower.poll(), range(2, 4))
        record(dataset, range(4, 6))
    assert count(root) == [1, 1]
    check_episodes(follower.poll(), range(4, 6))
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(6, 7))
    check_episodes(follower.poll(), range(6, 7))
    check_episodes(read_episodes(root), range(7))


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize("refused", ["data", "episodes"])
def test_where_folders_cannot_be_exchanged_all_stays_as_it_is(refused, tmp_path, monkeypatch, caplog) -> None:
    swap = exchange._exchange

    def refuse(first, second) -> None:
        if second.name == refused:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        swap(first, second)

    monkeypatch.setattr(exchange, "_exchange", refuse)
    new_dataset(tmp_path / "d", 5)
    assert count(tmp_path / "d") == [5, 5]
    assert "keeps its many small files (Invalid argument)" in caplog.text
    check_dataset(tmp_path / "d", 5)
    assert not (tmp_path / "d" / "images").exists()
