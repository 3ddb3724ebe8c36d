"""A Hub that sends next to nothing does not keep a run from beginning."""

import time

import pytest

from relmm.episodes import local_root, patience
from relmm.episodes.remote import reserve
from relmm.errors import DatasetError

SIZE = 3000  # bytes


@pytest.fixture
def impatient(hub, monkeypatch):
    """A Hub with a dataset of one large file, and a second of patience with it."""
    hub.create("me/run", "datasets", {"meta/info.json": b" " * SIZE})
    monkeypatch.setattr(patience, "_TIMEOUT_S", 1.0)
    for name in ("HF_HUB_DOWNLOAD_TIMEOUT", "HF_HUB_ETAG_TIMEOUT", "DEFAULT_ETAG_TIMEOUT"):
        monkeypatch.setattr(f"huggingface_hub.constants.{name}", 1)
    patience.limit_waiting.cache_clear()
    yield hub
    patience.limit_waiting.cache_clear()


def test_a_byte_now_and_then_is_not_enough_for_the_list_of_files(impatient, fault):
    impatient.faults.append(fault("/api/", drip_s=0.2))
    started = time.monotonic()
    with pytest.raises(DatasetError, match=r"failed \(ReadTimeout: .*\); try again"):
        local_root("me/run@main")
    assert time.monotonic() - started < 20


def test_a_byte_now_and_then_is_not_enough_for_a_file(impatient, fault):
    impatient.faults.append(fault("GET /datasets/me/run/resolve/", drip_s=0.2))
    with pytest.raises(DatasetError, match="me/run") as caught:
        local_root("me/run@main")
    assert "\n" not in str(caught.value)


def test_a_byte_now_and_then_is_not_enough_for_what_comes_before_a_run(impatient, fault):
    impatient.faults.append(fault("/repos/create", drip_s=0.2))
    assert "uploads may fail for now" in reserve("me/new", "dataset", None, None)


def test_a_large_file_may_take_longer_than_the_patience(impatient, fault, monkeypatch):
    monkeypatch.setattr(patience, "_SLOWEST", 200.0)
    impatient.faults.append(fault("GET /datasets/me/run/resolve", drip_s=0.001))
    started = time.monotonic()
    assert (local_root("me/run@main") / "meta/info.json").stat().st_size == SIZE
    assert time.monotonic() - started > 2
