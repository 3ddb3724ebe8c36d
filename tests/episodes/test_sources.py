"""Growing datasets of many robots, read as one stream."""

import shutil

import pytest
from episode_helpers import META, check_episode, record

from relmm.episodes import DurableDataset
from relmm.episodes.sources import Cursor, Sources
from relmm.errors import DatasetError


def made(root, episodes, started="then"):
    """A dataset that no other is a copy of."""
    info = {"camera": "paper", "started": f"{root.name} {started}"}
    with DurableDataset.create("me/d", root, False, "locobot_sim", info) as dataset:
        record(dataset, range(episodes))
    return root


def more(root, episodes, first):
    with DurableDataset.open(root, "me/d") as dataset:
        record(dataset, range(first, first + episodes))


def taken(sources):
    return [(source.root.name, episode.index) for source, episode in sources.read_new()]


def test_each_episode_comes_once_whoever_recorded_it(tmp_path):
    places = [made(tmp_path / name, number) for name, number in (("a", 2), ("b", 1))]
    sources = Sources(places, "paper")
    assert taken(sources) == [("a", 0), ("a", 1), ("b", 0)]
    assert taken(sources) == []
    more(places[1], 1, first=1)
    more(places[0], 1, first=2)
    assert taken(sources) == [("a", 2), ("b", 1)]
    assert [source.cursor.episodes for source in sources.all] == [3, 2]


def test_robots_join_a_folder_of_datasets_at_any_time(tmp_path):
    folder = tmp_path / "robots"
    sources = Sources([folder], None)
    assert taken(sources) == []
    folder.mkdir()
    made(folder / "a", 1)
    assert taken(sources) == [("a", 0)]
    made(folder / "b", 1)
    assert taken(sources) == [("b", 0)]


def test_a_reading_that_was_stopped_in_the_middle_goes_on_there(tmp_path):
    places = [made(tmp_path / name, 2) for name in "ab"]
    sources = Sources(places, None)
    for source, episode in sources.read_new():
        check_episode(episode, 0)
        assert source.root == places[0]
        break
    assert sources.waiting == 3
    assert taken(sources) == [("a", 1), ("b", 0), ("b", 1)]
    assert sources.waiting == 0


def test_what_an_earlier_run_has_learned_from_comes_first_and_apart(tmp_path):
    places = [made(tmp_path / name, 3) for name in "ab"]
    sources = Sources(places, None)
    for _ in zip(range(4), sources.read_new(), strict=False):
        pass
    cursors = [source.cursor for source in sources.all]
    assert [cursor.episodes for cursor in cursors] == [3, 1]
    again = Sources(places, None, cursors)
    read = [(source.root.name, episode.index) for source, episode in again.read_learned()]
    assert read == [("a", 0), ("a", 1), ("a", 2), ("b", 0)]
    assert taken(again) == [("b", 1), ("b", 2)]


def test_a_cursor_finds_its_dataset_wherever_it_has_been_moved_to(tmp_path):
    cursors = [s.cursor for s in Sources([made(tmp_path / "a", 1), made(tmp_path / "b", 2)], None).all]
    cursors[0].episodes, cursors[1].episodes = 1, 2
    (tmp_path / "new").mkdir()
    for name in "ab":
        (tmp_path / name).rename(tmp_path / "new" / f"robot_{name}")
    sources = Sources([tmp_path / "new"], None, cursors)
    assert not sources.missing
    assert {source.root.name: source.learned for source in sources.all} == {"robot_a": 1, "robot_b": 2}


@pytest.mark.parametrize("change", ["removed", "shorter", "another"])
def test_a_dataset_that_lacks_what_was_learned_is_missing(tmp_path, change):
    root = made(tmp_path / "a", 2)
    cursor = Cursor(str(root), 3 if change == "shorter" else 2, Sources([root], None).all[0].runs)
    if change != "shorter":
        shutil.rmtree(root)
    if change == "another":
        made(root, 2, started="later")
    assert Sources([root], None, [cursor]).missing == [cursor]


def test_a_copy_is_refused_where_it_was_named_and_left_out_of_a_folder(tmp_path):
    folder = tmp_path / "robots"
    folder.mkdir()
    shutil.copytree(made(folder / "a", 2), folder / "b")
    with pytest.raises(DatasetError, match=r"a hold the same recording, .* leave one of them out"):
        Sources([folder / "a", folder / "b"], None)
    sources = Sources([folder], None)
    assert taken(sources) == [("a", 0), ("a", 1)]
    assert list(sources.problems) == [folder / "b"]


def test_one_bad_robot_does_not_end_the_learning_of_all(tmp_path):
    folder = tmp_path / "robots"
    folder.mkdir()
    for name in "abc":
        made(folder / name, 1)
    (folder / "b" / META.format(0)).write_bytes(b"nothing")
    sources = Sources([folder], None)
    assert taken(sources) == [("a", 0), ("c", 0)]
    assert "missing or cut off" in sources.problems[folder / "b"]
    with pytest.raises(DatasetError, match="camera paper"):
        Sources([folder / "a"], "d435")
    assert len(Sources([folder], "d435").problems) == 3


def test_a_quiet_dataset_is_not_read_again(tmp_path, monkeypatch):
    root = made(tmp_path / "a", 1)
    sources = Sources([root], None)
    monkeypatch.setattr("relmm.episodes.sources._SETTLED_S", -1.0)
    assert taken(sources) == [("a", 0)]
    monkeypatch.setattr(type(sources.all[0].follower), "read_new", lambda self: pytest.fail("it was read"))
    assert taken(sources) == []
