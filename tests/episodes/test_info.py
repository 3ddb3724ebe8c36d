"""An `info.json` of nonsense counts as unreadable: refused by who reads it, and rebuilt by a repair."""

import json

import pytest
from episode_helpers import check_episode, new_dataset

from relmm.episodes import read_episodes, verify_and_repair
from relmm.episodes.compact import compact
from relmm.errors import DatasetError

NONSENSE = {
    "deep": b"[" * 100_000,
    "no text": b"\xff\xfe\x00",
    "half a character": lambda info: info | {"robot_type": "\ud800"},
    "columns without descriptions": lambda info: info | {"features": dict.fromkeys(info["features"], 1)},
    "no columns": lambda info: info | {"features": "all"},
    "no shape": lambda info: info | {"features": {"action": {"dtype": "float32"}}},
    "a shape of numbers": lambda info: info | {"features": info["features"] | {"x": {"dtype": "int64", "shape": 1}}},
    "a path with braces": lambda info: info | {"data_path": "{0.__class__}/{chunk_index.real}"},
    "no path": lambda info: info | {"data_path": 3.5},
    "size of files": lambda info: info | {"data_files_size_in_mb": "100"},
}


@pytest.mark.parametrize("nonsense", NONSENSE.values(), ids=NONSENSE)
def test_nonsense(tmp_path, nonsense):
    root = tmp_path / "run"
    new_dataset(root, 2)
    path = root / "meta/info.json"
    healthy = json.loads(path.read_text())
    path.write_bytes(nonsense if isinstance(nonsense, bytes) else json.dumps(nonsense(healthy)).encode())
    with pytest.raises(DatasetError):
        compact(root, tmp_path / "copy")
    assert verify_and_repair(root).problems == ["meta/info.json was rebuilt"]
    assert json.loads(path.read_text()) == healthy
    assert [check_episode(episode, number) for number, episode in enumerate(read_episodes(root))] == [None, None]


def test_runs_of_nonsense_are_none(tmp_path):
    root = tmp_path / "run"
    new_dataset(root, 2)
    path = root / "meta/relmm.json"
    own = json.loads(path.read_text())
    for runs in (1, "x", [1], [None], {"a": 1}):
        path.write_text(json.dumps(own | {"runs": runs}))
        assert len(list(read_episodes(root))) == 2
    path.write_text(json.dumps(own | {"features": [1]}))
    (root / "meta/info.json").unlink()
    with pytest.raises(DatasetError, match="restore one of them first"):
        verify_and_repair(root)
