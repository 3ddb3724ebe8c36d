"""Episodes of robots that come, go and lose the link arrive once and in order; weights come back."""

import json
import shutil

import grpc
import numpy as np
import pyarrow.parquet as pq
import pytest
from episode_helpers import check_episodes, load, new_dataset, record

from relmm.episodes import DurableDataset, read_episodes, verify_and_repair
from relmm.errors import FleetError
from relmm.fleet import wire
from relmm.fleet.client import Link, fetch_weights
from relmm.fleet.sealed import SealedReader
from relmm.fleet.wire import LinkError, RestartError, call, pack

NAME = "me/d"


def more(root, episodes):
    with DurableDataset.open(root, NAME) as dataset:
        record(dataset, episodes)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A dataset of two episodes."""
    root = tmp_path_factory.mktemp("recorded") / "robot"
    new_dataset(root, 2)
    return root


@pytest.fixture
def robot(recorded, tmp_path):
    """It, to be changed."""
    return shutil.copytree(recorded, tmp_path / "robot")


@pytest.fixture
def mirror(tmp_path):
    return tmp_path / "server" / "me--d"


def registered(channel, robot):
    header = {"name": NAME, "dataset": json.loads((robot / "meta/relmm.json").read_text())}
    return call(channel, "register", header, b"", 10)[0]


# --- Episodes ------------------------------------------------------------------------------------------------
def test_the_mirror_is_the_robots_dataset(serve, connect, robot, mirror):
    link = Link(connect(serve()), robot, NAME, None)
    link.sync()
    check_episodes(read_episodes(mirror), range(2))
    more(robot, range(2, 5))
    link.sync()
    assert link.waiting == 0
    check_episodes(read_episodes(mirror, camera="paper"), range(5))
    ours, theirs = load(robot), load(mirror)
    assert len(ours) == len(theirs)
    for index in range(len(ours)):
        for key, value in ours[index].items():
            assert np.array_equal(np.asarray(value), np.asarray(theirs[index][key])), key
    report = verify_and_repair(mirror)
    assert (report.episodes, report.problems) == (5, ["meta/stats.json was rebuilt"])


@pytest.mark.parametrize("answers", [False, True])
def test_a_link_that_is_cut_at_any_message_loses_and_repeats_nothing(
    serve, connect, robot, tmp_path, monkeypatch, answers
):
    monkeypatch.setattr("relmm.fleet.client.CHUNK_BYTES", 100_000)  # three for an episode
    sent, left, cuts = wire.call, 0, 0

    def cut_off(*message):
        nonlocal left, cuts
        left -= 1
        answer = sent(*message) if left or answers else b""
        if left == 0:
            cuts += 1
            raise LinkError("cut")
        return answer

    monkeypatch.setattr("relmm.fleet.client.call", cut_off)
    server = serve()
    channel, total = connect(server), 9
    for message in range(1, total):
        left = message
        link = Link(channel, robot, f"me/d{message}", None)
        while cuts < message or link.waiting:
            try:
                link.sync()
            except (LinkError, RestartError):
                continue
            if not link.waiting and cuts < message:
                break  # there were fewer messages
        check_episodes(read_episodes(tmp_path / "server" / f"me--d{message}"), range(2))
    assert cuts >= 6
    assert server.received == 2 * (total - 1)


def test_a_robot_that_is_restarted_goes_on_where_the_server_is(serve, connect, robot, mirror):
    server = serve()
    Link(connect(server), robot, NAME, None).sync()
    more(robot, range(2, 4))
    Link(connect(server), robot, NAME, None).sync()
    assert server.received == 4
    check_episodes(read_episodes(mirror), range(4))


def test_a_server_that_is_restarted_goes_on_where_its_disk_is(serve, connect, robot, mirror):
    server = serve()
    link = Link(connect(server), robot, NAME, None)
    link.sync()
    server.__exit__(None, None, None)
    more(robot, range(2, 3))
    with pytest.raises(LinkError):
        link.sync()
    assert link.waiting == 1
    serve(server.port)
    for _ in range(100):  # until the channel has noticed
        try:
            link.sync()
        except (LinkError, RestartError):
            continue
        break
    check_episodes(read_episodes(mirror), range(3))


def test_a_mirror_that_was_cut_off_repairs_itself(serve, connect, robot, mirror):
    server = serve()
    Link(connect(server), robot, NAME, None).sync()
    server.__exit__(None, None, None)
    (mirror / "meta/info.json").unlink()
    (mirror / "data/chunk-000/file-001.parquet").write_bytes(b"cut")
    Link(connect(serve()), robot, NAME, None).sync()
    check_episodes(read_episodes(mirror), range(2))


def test_a_replaced_recorder_takes_over_and_the_first_is_refused(serve, connect, robot):
    channel = connect(serve())
    old = registered(channel, robot)
    new = registered(channel, robot)
    episode = next(SealedReader(robot, 0).read_new())
    with pytest.raises(RestartError, match="register again"):
        call(channel, "heartbeat", {"session": old["session"], "waiting": 0}, b"", 10)
    with pytest.raises(RestartError, match="register again"):
        put(channel, old, episode.content)
    put(channel, new, episode.content)


def test_a_packed_dataset_is_sent_like_any_other(serve, connect, tmp_path, robot, mirror):
    from relmm.episodes.compact import compact

    more(robot, range(2, 6))
    compact(robot, tmp_path / "packed")
    assert len(list((tmp_path / "packed").glob("data/*/*.parquet"))) == 1
    Link(connect(serve()), tmp_path / "packed", NAME, None).sync()
    check_episodes(read_episodes(mirror), range(6))


def test_the_thread_sends_what_is_saved_and_finish_waits_for_it(serve, connect, robot, mirror):
    with Link(connect(serve()), robot, NAME, None) as link:
        more(robot, range(2, 4))
        assert link.finish() == 0
    check_episodes(read_episodes(mirror), range(4))


# --- What is refused -----------------------------------------------------------------------------------------
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


def test_without_tls_nothing_gets_through(serve, robot, tmp_path):
    server = serve()
    channel = grpc.insecure_channel(f"localhost:{server.port}")
    with pytest.raises(LinkError):
        registered(channel, robot)
    channel.close()
    assert not written(tmp_path / "server")


def test_a_server_that_nobody_vouches_for_is_not_talked_to(serve, connect, robot, tmp_path):
    with pytest.raises(LinkError):
        registered(connect(serve(), certificate=None), robot)
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
    more(robot, range(2, 3))
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
def test_a_false_claim_is_refused(serve, connect, robot, mirror, changes, words):
    channel = connect(serve())
    answer = registered(channel, robot)
    before = written(mirror)
    with pytest.raises(FleetError, match=words):
        put(channel, answer, next(SealedReader(robot, 0).read_new()).content, **changes)
    assert written(mirror) == before


def test_a_replayed_message_is_refused_and_changes_nothing(serve, connect, robot, mirror):
    channel = connect(serve())
    answer = registered(channel, robot)
    content = next(SealedReader(robot, 0).read_new()).content
    put(channel, answer, content)
    before = {path: path.read_bytes() for path in written(mirror)}
    with pytest.raises(RestartError, match="episode 0 of me/d is not the next one, which is 1"):
        put(channel, answer, content)
    assert {path: path.read_bytes() for path in written(mirror)} == before


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
def test_an_episode_that_no_recorder_writes_is_refused(serve, connect, robot, mirror, bad):
    channel = connect(serve())
    answer = registered(channel, robot)
    before = written(mirror)
    content = next(SealedReader(robot, 0).read_new()).content
    with pytest.raises(FleetError) as refused:
        put(channel, answer, BAD[bad](content))
    assert "\n" not in str(refused.value)
    assert str(mirror) not in str(refused.value)
    assert written(mirror) == before
    put(channel, answer, content)
    check_episodes(read_episodes(mirror), [0])


# --- Weights -------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A checkpoint of a policy that has learned nothing."""
    import relmm.plugin  # noqa: F401
    from relmm.commands.policies import make_actor
    from relmm.learning.sums import write_sums
    from relmm.policies.relmm.configuration_relmm import ReLMMConfig

    folder = tmp_path_factory.mktemp("policy") / "000007" / "pretrained_model"
    make_actor(ReLMMConfig(num_members=1, channels=2, device="cpu")).save_pretrained(folder)
    write_sums(folder)
    (folder / "train_config.json").write_text('{"secret": "paths of this machine"}')
    return folder.parent


@pytest.fixture
def run(tmp_path, policy):
    """The checkpoints of a run."""
    folder = tmp_path / "run" / "checkpoints"
    shutil.copytree(policy, folder / "000007")
    (folder / "last").symlink_to("000007")
    return folder


def test_weights_come_with_all_that_a_policy_needs_and_nothing_else(serve, connect, run, tmp_path, monkeypatch):
    monkeypatch.setattr("relmm.fleet.server.CHUNK_BYTES", 10_000)
    assert fetch_weights(connect(serve()), tmp_path / "here")
    here = tmp_path / "here" / "last" / "pretrained_model"
    there = run / "last" / "pretrained_model"
    assert {path.name for path in here.iterdir()} == {path.name for path in there.iterdir()} - {"train_config.json"}
    assert all((here / path.name).read_bytes() == path.read_bytes() for path in here.iterdir())
    assert here.resolve().parent.name == "000007"


def test_no_weights_yet_is_no_error(serve, connect, tmp_path):
    assert fetch_weights(connect(serve()), tmp_path / "here") == ""


def test_a_robot_gets_newer_weights_when_there_are_some(serve, connect, robot, run, policy, tmp_path, monkeypatch):
    monkeypatch.setattr("relmm.fleet.server._LOOK_S", 0.0)
    monkeypatch.setattr("relmm.fleet.client._HEARTBEAT_S", 0.0)
    link = Link(connect(serve()), robot, NAME, tmp_path / "here")
    link.sync()
    assert (tmp_path / "here" / "last").resolve().name == "000007"
    newer = shutil.copytree(policy, run / "000009") / "pretrained_model"
    (newer / "config.json").write_text((newer / "config.json").read_text() + "\n")
    (newer / "SHA256SUMS").unlink()
    (run / "last").unlink()
    (run / "last").symlink_to("000009")
    link.sync()
    assert [path.name for path in sorted((tmp_path / "here").iterdir())] == ["000009", "last"]
    assert (tmp_path / "here" / "last").resolve().name == "000009"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("model.safetensors", b"\x80\x04N."),
        ("config.json", b'{"type": "act"}'),
        ("policy_preprocessor.json", b'{"steps": [{"class": "os.system"}]}'),
        ("evil.pkl", b"\x80\x04N."),
        ("../evil.json", b"{}"),
    ],
)
def test_weights_that_the_hub_checks_refuse_are_not_installed(policy, tmp_path, name, content):
    from relmm.fleet.weights import unpack_policy

    files = {path.name: path.read_bytes() for path in (policy / "pretrained_model").iterdir() if path.suffix != ".txt"}
    files = {key: value for key, value in files.items() if key not in ("SHA256SUMS", "train_config.json")}
    files[name] = content
    blob = pack(
        {"step": "000007", "files": [[key, len(value)] for key, value in files.items()]}, b"".join(files.values())
    )
    with pytest.raises(FleetError, match="the server's weights cannot be used"):
        unpack_policy(blob, tmp_path / "here")
    assert not list((tmp_path / "here").iterdir())
