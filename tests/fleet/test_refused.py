"""What a server and its robots refuse: in one sentence, with nothing written."""

import json
import shutil

import grpc
import pyarrow.parquet as pq
import pytest
from episode_helpers import check_episodes, record_more

from relmm.episodes import read_episodes
from relmm.errors import FleetError
from relmm.fleet import wire
from relmm.fleet.client import Link
from relmm.fleet.sealed import SealedReader
from relmm.fleet.wire import LinkError, RestartError, call, pack

NAME = "me/d"


def put(channel, answer, content, **changes):
    import hashlib

    header = {"session": answer["session"], "episode": 0, "offset": 0, "size": len(content)}
    header["sha256"] = hashlib.sha256(content).hexdigest()
    return call(channel, "put", header | changes, content, 10)


def written(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")


def test_a_wrong_token_is_refused(serve, connect, robot, tmp_path):
    link = Link(connect(serve(), token="0123456789abcdeg"), robot, NAME, None)
    with pytest.raises(FleetError, match=r"^the token is not the server's: .*\.$"):
        link.sync()
    assert not written(tmp_path / "server")


def test_without_tls_nothing_gets_through(serve, robot, tmp_path, register):
    server = serve()
    channel = grpc.insecure_channel(f"localhost:{server.port}")
    with pytest.raises(LinkError):
        register(channel, robot)
    channel.close()
    assert not written(tmp_path / "server")


def test_a_server_that_nobody_vouches_for_is_not_talked_to(serve, connect, robot, tmp_path, register):
    with pytest.raises(LinkError):
        register(connect(serve(), certificate=None), robot)
    assert not written(tmp_path / "server")


def test_another_version_is_refused(serve, connect, robot, tmp_path, monkeypatch):
    channel = connect(serve())
    monkeypatch.setattr("relmm.fleet.wire.VERSION", "2")
    with pytest.raises(FleetError, match="version 1 of the fleet's protocol, and this is version 2: install the same"):
        call(channel, "heartbeat", {}, b"", 10)
    assert not written(tmp_path / "server")


def schema(robot):
    return json.loads((robot / "meta/relmm.json").read_text())


def other_column(dataset):
    dataset["features"]["action"]["shape"] = [4]


def extra_column(dataset):
    dataset["features"]["secret"] = {"dtype": "string", "shape": [1], "names": None}


def other_camera(dataset):
    dataset["features"]["observation.images.front"]["info"]["camera"]["name"] = "d435"


def no_runs(dataset):
    dataset["runs"] = []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (other_column, r"column action: have float32 \(4,\)"),
        (extra_column, "column secret: have string"),
        (other_camera, "camera: have d435"),
        (lambda dataset: dataset.pop("features"), "does not say which columns"),
        (no_runs, "belongs to another recording"),
    ],
)
def test_another_schema_or_camera_is_refused(serve, connect, robot, tmp_path, change, words):
    dataset = schema(robot)
    change(dataset)
    (robot / "meta/relmm.json").write_text(json.dumps(dataset))
    with pytest.raises(FleetError, match=words):
        Link(connect(serve()), robot, NAME, None).sync()
    assert not written(tmp_path / "server")


@pytest.mark.parametrize("name", ["d", "../../etc/d", "me/../d", "me/d/e", "me/" + "d" * 200, 5])
def test_a_name_that_is_none_is_refused(serve, connect, robot, tmp_path, name):
    with pytest.raises(FleetError):
        call(connect(serve()), "register", {"name": name, "dataset": schema(robot)}, b"", 10)
    assert not written(tmp_path / "server")


def test_another_recording_of_the_same_name_is_refused(serve, connect, robot, tmp_path):
    server = serve()
    Link(connect(server), robot, NAME, None).sync()
    before = written(tmp_path / "server")
    dataset = schema(robot)
    dataset["runs"][0]["started"] = "at another time"
    (robot / "meta/relmm.json").write_text(json.dumps(dataset))
    with pytest.raises(FleetError, match="the name me/d belongs to another recording"):
        Link(connect(server), robot, NAME, None).sync()
    assert written(tmp_path / "server") == before


def test_an_older_copy_is_refused(serve, connect, robot, tmp_path):
    server = serve()
    shutil.copytree(robot, tmp_path / "older")
    record_more(robot, range(2, 3))
    Link(connect(server), robot, NAME, None).sync()
    dataset = schema(robot)
    (tmp_path / "older/meta/relmm.json").write_text(json.dumps(dataset))
    with pytest.raises(FleetError, match="the server has 3 episodes of me/d and this machine 2"):
        Link(connect(server), tmp_path / "older", NAME, None).sync()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"size": 10 << 30}, "claims 10,737 MB, and at most 268 MB are plausible"),
        ({"size": -1}, "size is -1"),
        ({"episode": 1}, "episode 1 of me/d is not the next one, which is 0"),
        ({"offset": 5}, "does not follow on"),
        ({"size": 5}, "does not follow on"),
        ({"sha256": "0" * 64}, "damaged on its way"),
    ],
)
def test_a_false_claim_is_refused(serve, connect, robot, mirror, changes, words, register):
    channel = connect(serve())
    answer = register(channel, robot)
    before = written(mirror)
    with pytest.raises(FleetError, match=words):
        put(channel, answer, next(SealedReader(robot, 0).read_new()).content, **changes)
    assert written(mirror) == before


def test_a_replayed_message_is_refused_and_changes_nothing(serve, connect, robot, mirror, register):
    channel = connect(serve())
    answer = register(channel, robot)
    content = next(SealedReader(robot, 0).read_new()).content
    put(channel, answer, content)
    before = {path: path.read_bytes() for path in written(mirror)}
    with pytest.raises(RestartError, match="episode 0 of me/d is not the next one, which is 1"):
        put(channel, answer, content)
    assert {path: path.read_bytes() for path in written(mirror)} == before


def test_a_replaced_recorder_takes_over_and_the_first_is_refused(serve, connect, robot, register):
    channel = connect(serve())
    old = register(channel, robot)
    new = register(channel, robot)
    episode = next(SealedReader(robot, 0).read_new())
    with pytest.raises(RestartError, match="register again"):
        call(channel, "heartbeat", {"session": old["session"], "waiting": 0}, b"", 10)
    with pytest.raises(RestartError, match="register again"):
        put(channel, old, episode.content)
    put(channel, new, episode.content)


def changed(content, change):
    """An episode whose frames, or whose row of the list, were changed."""
    import pyarrow as pa

    header, body = wire.unpack(content)
    tables = [pq.read_table(pa.BufferReader(part)) for part in (body[: header["data"]], body[header["data"] :])]
    tables = change(*tables)
    parts = []
    for table in tables:
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        parts.append(bytes(sink.getvalue()))
    return pack({"data": len(parts[0])}, b"".join(parts))


def replaced(table, name, value):
    import pyarrow as pa

    at = table.column_names.index(name)
    return table.set_column(at, name, pa.array([value] * len(table), table.schema.field(name).type))


BAD = {
    "no parquet": lambda content: pack({"data": 5}, b"hello world"),
    "no header": lambda content: b"\xff\xff\xff\xff",
    "cut": lambda content: changed(content, lambda frames, row: (frames.slice(0, 1), row)),
    "of another number": lambda content: changed(
        content, lambda frames, row: (replaced(frames, "episode_index", 3), row)
    ),
    "elsewhere": lambda content: changed(content, lambda frames, row: (frames, replaced(row, "dataset_from_index", 9))),
    "more columns": lambda content: changed(content, lambda f, row: (f.append_column("x", f["index"]), row)),
    "not finite": lambda content: changed(content, lambda f, row: (replaced(f, "next.reward", float("nan")), row)),
    "no picture": lambda content: changed(
        content, lambda f, row: (replaced(f, "observation.images.front", {"bytes": b"no", "path": None}), row)
    ),
    "another task": lambda content: changed(content, lambda frames, row: (replaced(frames, "task_index", 7), row)),
}


@pytest.mark.parametrize("bad", BAD)
def test_an_episode_that_no_recorder_writes_is_refused(serve, connect, robot, mirror, bad, register):
    channel = connect(serve())
    answer = register(channel, robot)
    before = written(mirror)
    content = next(SealedReader(robot, 0).read_new()).content
    with pytest.raises(FleetError) as refused:
        put(channel, answer, BAD[bad](content))
    assert "\n" not in str(refused.value)
    assert str(mirror) not in str(refused.value)
    assert written(mirror) == before
    put(channel, answer, content)
    check_episodes(read_episodes(mirror), [0])
