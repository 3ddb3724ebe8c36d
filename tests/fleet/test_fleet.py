"""Episodes of robots that come, go and lose the link arrive once and in order."""

import numpy as np
import pytest
from episode_helpers import check_episodes, load, record_more

from relmm.episodes import read_episodes, verify_and_repair
from relmm.fleet import wire
from relmm.fleet.client import Link
from relmm.fleet.wire import LinkError, RestartError

NAME = "me/d"


def test_the_mirror_is_the_robots_dataset(serve, connect, robot, mirror):
    link = Link(connect(serve()), robot, NAME, None)
    link.sync()
    check_episodes(read_episodes(mirror), range(2))
    record_more(robot, range(2, 5))
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
    record_more(robot, range(2, 4))
    Link(connect(server), robot, NAME, None).sync()
    assert server.received == 4
    check_episodes(read_episodes(mirror), range(4))


def test_a_server_that_is_restarted_goes_on_where_its_disk_is(serve, connect, robot, mirror):
    server = serve()
    link = Link(connect(server), robot, NAME, None)
    link.sync()
    server.__exit__(None, None, None)
    record_more(robot, range(2, 3))
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


def test_a_packed_dataset_is_sent_like_any_other(serve, connect, tmp_path, robot, mirror):
    from relmm.episodes.compact import compact

    record_more(robot, range(2, 6))
    compact(robot, tmp_path / "packed")
    assert len(list((tmp_path / "packed").glob("data/*/*.parquet"))) == 1
    Link(connect(serve()), tmp_path / "packed", NAME, None).sync()
    check_episodes(read_episodes(mirror), range(6))


def test_the_thread_sends_what_is_saved_and_finish_waits_for_it(serve, connect, robot, mirror):
    with Link(connect(serve()), robot, NAME, None) as link:
        record_more(robot, range(2, 4))
        assert link.finish() == 0
    check_episodes(read_episodes(mirror), range(4))
