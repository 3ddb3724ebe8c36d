"""Datasets on their way to the Hub and back, over real HTTP."""

import json
import re
import resource
import signal

import numpy as np
import pyarrow.parquet as pq
import pytest
from episode_helpers import INFO, REPO_ID, check_dataset, check_episode, length_of, load, new_dataset, record

from relmm.episodes import DurableDataset, FrameBuilder, local_root, read_episodes, summarize, upload_dataset
from relmm.episodes.card import dataset_card
from relmm.episodes.compact import compact
from relmm.episodes.folder import DatasetFolder
from relmm.errors import ConfigError, DatasetError, HubError
from relmm.features import DATASET_COLUMNS, dataset_features

NAME = "me/room"


def snapshot(root):
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_a_compact_copy_holds_the_same_frames(tmp_path):
    new_dataset(tmp_path / "d", 7)
    before = snapshot(tmp_path / "d")
    assert compact(tmp_path / "d", tmp_path / "copy") == 7
    assert snapshot(tmp_path / "d") == before
    assert len(list(tmp_path.glob("copy/data/*/*"))) == len(list(tmp_path.glob("copy/meta/episodes/*/*"))) == 1
    assert not (tmp_path / "copy/images").exists()
    check_dataset(tmp_path / "copy", 7)
    one = pq.read_table(tmp_path / "copy/data/chunk-000/file-000.parquet", partitioning=None)
    many = [pq.read_table(path, partitioning=None) for path in sorted(tmp_path.glob("d/data/*/*"))]
    start = 0
    for table in many:  # pictures as compressed bytes, and everything else
        assert one.slice(start, len(table)).equals(table)
        start += len(table)
    assert pq.ParquetFile(tmp_path / "copy/data/chunk-000/file-000.parquet").num_row_groups == 7
    ours, theirs = (json.loads((tmp_path / d / "meta/info.json").read_text()) for d in ("d", "copy"))
    assert ours == theirs
    copied = load(tmp_path / "copy").meta.stats
    for key, statistics in load(tmp_path / "d").meta.stats.items():
        for name, values in statistics.items():
            np.testing.assert_allclose(copied[key][name], values, rtol=1e-6, atol=1e-9)


def test_large_datasets_have_several_files(tmp_path):
    new_dataset(tmp_path / "d", 6)
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    size = max(path.stat().st_size for path in tmp_path.glob("d/data/*/*"))
    assert size < 1 << 20
    (tmp_path / "d/meta/info.json").write_text(json.dumps(info | {"data_files_size_in_mb": 1, "chunks_size": 2}))
    with DurableDataset.open(tmp_path / "d", REPO_ID) as dataset:
        record(dataset, range(6, 24))
    compact(tmp_path / "d", tmp_path / "copy")
    files = sorted(path.relative_to(tmp_path / "copy").as_posix() for path in tmp_path.glob("copy/data/*/*"))
    assert files[:3] == [f"data/chunk-00{c}/file-00{f}.parquet" for c, f in ((0, 0), (0, 1), (1, 0))]
    assert all(path.stat().st_size <= 1 << 20 for path in tmp_path.glob("copy/data/*/*"))
    check_dataset(tmp_path / "copy", 24)
    with DurableDataset.open(tmp_path / "copy", REPO_ID) as dataset:
        record(dataset, range(24, 25))
    check_dataset(tmp_path / "copy", 25)


def test_lerobot_can_delete_episodes_of_the_copy(tmp_path):
    from lerobot.datasets.dataset_tools import delete_episodes

    new_dataset(tmp_path / "d", 4)
    compact(tmp_path / "d", tmp_path / "copy")
    smaller = delete_episodes(load(tmp_path / "copy"), [1], output_dir=tmp_path / "smaller", repo_id="tester/smaller")
    assert smaller.num_episodes == 3


def test_upload_and_download(tmp_path, hub):
    new_dataset(tmp_path / "d", 3)
    before = snapshot(tmp_path / "d")
    uploaded = upload_dataset(tmp_path / "d", NAME)
    assert snapshot(tmp_path / "d") == before
    repo = hub.repo(NAME, "datasets")
    assert uploaded.episodes == 3
    assert repo.tags == {"v3.0": uploaded.revision}
    assert repo.refs["main"] == uploaded.revision
    assert not repo.private
    root = local_root(NAME)
    for number, episode in enumerate(read_episodes(root)):
        check_episode(episode, number)
    assert number == 2


def test_later_uploads_move_the_tag_and_send_what_is_new(tmp_path, hub):
    new_dataset(tmp_path / "d", 2)
    first = upload_dataset(tmp_path / "d", NAME)
    assert upload_dataset(tmp_path / "d", NAME).revision == first.revision, "nothing new, no commit"
    with DurableDataset.open(tmp_path / "d", REPO_ID, info=INFO) as dataset:
        record(dataset, range(2, 4))
    second = upload_dataset(tmp_path / "d", NAME)
    assert second.revision != first.revision
    assert hub.repo(NAME, "datasets").tags["v3.0"] == second.revision
    assert summarize(local_root(NAME)).episodes == 4
    assert summarize(local_root(f"{NAME}@{first.revision}")).episodes == 2


def test_what_is_not_durable_is_not_uploaded(tmp_path, hub):
    with DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim", INFO) as dataset:
        with pytest.raises(DatasetError, match="no whole episode yet"):
            upload_dataset(tmp_path / "d", NAME)
        assert not hub.repos
        record(dataset, range(2))
        dataset.add_frame(FrameBuilder(False).build(*_arguments()), "half an episode")
        (tmp_path / "d/data/chunk-000/file-002.parquet").write_bytes(b"PAR1 of an episode that is not listed yet")
        assert upload_dataset(tmp_path / "d", NAME).episodes == 2
    assert set(hub.repo(NAME, "datasets").files) == {
        ".gitattributes",
        "README.md",
        "contact_sheet.png",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        *(f"meta/{name}" for name in ("info.json", "stats.json", "tasks.parquet", "relmm.json")),
    }


def _arguments():
    from episode_helpers import arguments

    return arguments(2, 0)


def test_private(tmp_path, hub):
    new_dataset(tmp_path / "d", 1)
    upload_dataset(tmp_path / "d", NAME, private=True)
    assert hub.repo(NAME, "datasets").private
    upload_dataset(tmp_path / "d", "me/open")
    with pytest.raises(HubError, match="me/open is public, and a private one was asked for"):
        upload_dataset(tmp_path / "d", "me/open", private=True)


def test_another_dataset_is_not_replaced(tmp_path, hub):
    new_dataset(tmp_path / "d", 2)
    upload_dataset(tmp_path / "d", NAME)
    with DurableDataset.create(REPO_ID, tmp_path / "other", False, "locobot_sim", INFO | {"seed": 4}) as dataset:
        record(dataset, range(3))
    with pytest.raises(HubError, match="comes from another run; choose another name"):
        upload_dataset(tmp_path / "other", NAME)
    new_dataset(tmp_path / "shorter", 1)
    with pytest.raises(HubError, match="has 2 episodes and this one 1"):
        upload_dataset(tmp_path / "shorter", NAME)
    hub.create("me/foreign", "datasets", {"meta/info.json": b'{"total_episodes": 1}'})
    with pytest.raises(HubError, match="comes from another run; choose another name"):
        upload_dataset(tmp_path / "d", "me/foreign")
    assert summarize(local_root(NAME)).episodes == 2


def test_what_cannot_be_looked_at_is_not_replaced(tmp_path, hub, fault):
    with DurableDataset.create(REPO_ID, tmp_path / "other", False, "locobot_sim", INFO | {"seed": 4}) as dataset:
        record(dataset, range(1))
    upload_dataset(tmp_path / "other", NAME)
    before = hub.repo(NAME, "datasets").refs["main"]
    new_dataset(tmp_path / "d", 2)
    hub.faults.append(fault("/resolve/", status=500))
    with pytest.raises(HubError, match="nothing was uploaded"):
        upload_dataset(tmp_path / "d", NAME)
    assert hub.repo(NAME, "datasets").refs["main"] == before


def test_two_writers_at_the_same_moment(tmp_path, hub):
    new_dataset(tmp_path / "d", 1)
    upload_dataset(tmp_path / "d", NAME)
    with DurableDataset.open(tmp_path / "d", REPO_ID) as dataset:
        record(dataset, range(1, 2))
    hub.hooks.append(lambda repo: repo.commit(repo.files | {"note.md": b"someone was faster"}))
    with pytest.raises(HubError, match="somebody else wrote to the dataset me/room at the same moment; try again"):
        upload_dataset(tmp_path / "d", NAME)
    hub.hooks.clear()
    assert upload_dataset(tmp_path / "d", NAME).episodes == 2
    assert hub.repo(NAME, "datasets").files["note.md"] == b"someone was faster"


UPLOAD_FAULTS = {
    "500": ({"status": 500}, "HfHubHTTPError.*; try again"),
    "429": ({"status": 429}, r"too many requests \(429\); try again in some minutes"),
    "401": ({"status": 401}, "`hf auth login` with a token that may"),
    "403": ({"status": 403}, "`hf auth login` with a token that may"),
    "404": ({"status": 404, "headers": {"X-Error-Code": "RepoNotFound"}}, "no dataset me/room.*check the name"),
    "cut": ({"cut": True}, "try again"),
}
STEPS = ("POST /api/repos/create", "GET /api/datasets/me/room", "POST .*/preupload/", "POST .*/commit/", "/tag/")


@pytest.mark.parametrize(("settings", "words"), UPLOAD_FAULTS.values(), ids=UPLOAD_FAULTS)
def test_uploads_that_fail(tmp_path, hub, fault, settings, words):
    new_dataset(tmp_path / "d", 2)
    before = snapshot(tmp_path / "d")
    for step in STEPS if "status" not in settings or settings["status"] == 500 else STEPS[-2:]:
        hub.clear()
        hub.faults.append(fault(step, **settings))
        with pytest.raises(HubError, match=words) as caught:
            upload_dataset(tmp_path / "d", NAME)
        assert "\n" not in str(caught.value)
        assert hub.faults[0].hits, step
        assert snapshot(tmp_path / "d") == before
        hub.faults.clear()
        uploaded = upload_dataset(tmp_path / "d", NAME)
        assert hub.repo(NAME, "datasets").tags == {"v3.0": uploaded.revision}, "a later upload completes"
        assert summarize(local_root(f"{NAME}@{uploaded.revision}")).episodes == 2


def test_a_slow_hub_only_takes_longer(tmp_path, hub, fault):
    new_dataset(tmp_path / "d", 1)
    hub.faults.append(fault("", delay_s=0.1))
    assert upload_dataset(tmp_path / "d", NAME).episodes == 1


def test_a_hub_that_fails_now_and_then(tmp_path, hub, fault):
    new_dataset(tmp_path / "d", 1)
    hub.faults += [fault("preupload", status=503, times=2), fault("preupload", cut=True, times=1)]
    assert upload_dataset(tmp_path / "d", NAME).episodes == 1
    assert [each.hits for each in hub.faults] == [2, 1]


def test_no_room_for_the_copy(tmp_path, hub):
    new_dataset(tmp_path / "d", 2)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond it then fails with EFBIG
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))
    try:
        with pytest.raises(DatasetError, match=r"the copy of .* cannot be written to .*; make room there") as caught:
            upload_dataset(tmp_path / "d", NAME)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert "\n" not in str(caught.value)
    assert not hub.requests
    assert upload_dataset(tmp_path / "d", NAME).episodes == 2


def test_the_card_says_what_is_in_it(tmp_path, hub):
    from huggingface_hub import DatasetCard

    new_dataset(tmp_path / "d", 3, depth=True)
    upload_dataset(tmp_path / "d", NAME, license="cc-by-4.0")
    card = DatasetCard(hub.repo(NAME, "datasets").files["README.md"].decode())
    assert card.data.license == "cc-by-4.0"
    assert {"LeRobot", "relmm"} <= set(card.data.tags)
    assert card.data.configs == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    for words in ("| episodes | 3: 2 ended by success, 1 cut off |", "cc-by-4.0"):
        assert words in card.text
    summary = summarize(tmp_path / "d")
    # The Hub's visualiser refuses datasets without video.
    assert not re.search(r"visuali[sz]e|badge", card.text)
    assert f"| grasp attempts | {summary.grasps} |" in card.text
    assert f"| of them successful | {summary.successful_grasps} (" in card.text
    assert re.search(r"\| 0 \| no_obstacles \| paper \| 3 \|", card.text)
    assert set(dataset_features(True)) <= set(DATASET_COLUMNS)
    assert all(f"| `{key}` |" in card.text for key in dataset_features(True))
    assert card.text.count("camera paper (position [0.067, 0.0, 0.591], pitch 42.1, fov [60.0, 60.0])") == 2
    assert hub.repo(NAME, "datasets").files["contact_sheet.png"].startswith(b"\x89PNG")


def test_names_that_the_hub_refuses(tmp_path, hub):
    new_dataset(tmp_path / "d", 1)
    with pytest.raises(ConfigError, match="user/name"):
        upload_dataset(tmp_path / "d", "room")
    assert not hub.requests


def test_lengths_differ():
    assert len({length_of(episode) for episode in range(3)}) == 3


@pytest.mark.parametrize(("mode", "words"), [("practice", "from the pseudo-reset after one"), ("clean", "is one room")])
def test_the_card_says_what_an_episode_is(tmp_path, mode, words):
    with DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim", INFO | {"mode": mode}) as dataset:
        record(dataset, range(1))
    text = dataset_card(DatasetFolder(tmp_path / "d"), NAME, "apache-2.0", contact_sheet=False).text
    assert text.count("An episode ") == 1
    assert f"An episode {'goes ' if mode == 'practice' else ''}{words}" in text
