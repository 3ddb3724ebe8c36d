"""What test processes do before they are killed. They are imported by name, which test files are not."""

import itertools
import os
import resource
import signal

from episode_helpers import REPO_ID, TASK, arguments, length_of, record

from relmm.episodes import DurableDataset, EpisodeRecorder, compact, exchange
from relmm.errors import DatasetError


def die_after_renames(root, saved, done):
    """Save two more episodes, and be killed in the second after `done` of its renames."""
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(saved, saved + 1))
        replace, calls = os.replace, []

        def counted(source, target):
            if len(calls) == done:
                os.kill(os.getpid(), signal.SIGKILL)
            calls.append(target)
            replace(source, target)

        os.replace = counted
        record(dataset, range(saved + 1, saved + 2))
        os.kill(os.getpid(), signal.SIGKILL)


def record_until_killed(root, acknowledgements):
    with DurableDataset.open(root, REPO_ID) as dataset:
        while True:
            acknowledgements.send(dataset.episodes)
            record(dataset, range(dataset.episodes, dataset.episodes + 1))


def die_in_first_save(root):
    dataset = DurableDataset.create(REPO_ID, root, False, "locobot_sim")
    os.replace = lambda source, target: os.kill(os.getpid(), signal.SIGKILL)
    record(dataset, range(1))


def fill_limited_files(root, allowed):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    with DurableDataset.open(root, REPO_ID) as dataset:
        resource.setrlimit(resource.RLIMIT_FSIZE, (allowed, allowed))
        try:
            record(dataset, range(1, 2))
        except DatasetError as error:
            sentence = str(error)
    if "cannot be written (" in sentence and "1 episodes are saved and whole" in sentence:
        os._exit(7)


def end_without_closing(root, episodes):
    """Hand over these episodes and one unfinished, and end without waiting for the writer."""
    settings = {"depth": False, "robot_type": "locobot_sim", "info": {}}
    recorder = EpisodeRecorder(root, REPO_ID, resume=False, **settings)
    for episode in range(episodes):
        for step in range(length_of(episode)):
            recorder.add_frame(*arguments(episode, step), TASK)
        recorder.save_episode()
    recorder.add_frame(*arguments(99, 0), TASK)


def record_without_end(root, resume):
    recorder = EpisodeRecorder(root, REPO_ID, resume=resume, depth=False, robot_type="locobot_sim", info={})
    for episode in itertools.count(recorder.saved_episodes):
        for step in range(length_of(episode)):
            recorder.add_frame(*arguments(episode, step), TASK)
        recorder.save_episode()


def die_while_packing(root, done):
    """Be killed while small files become a few large ones: while they are copied (-1), or after `done` exchanges."""
    compact._MANY_FILES = 3
    swap, calls = exchange._exchange, []

    def counted(first, second):
        if len(calls) == done:
            os.kill(os.getpid(), signal.SIGKILL)
        calls.append(first)
        swap(first, second)

    exchange._exchange = counted
    kill_instead = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # noqa: E731
    if done < 0:
        compact._copy_episodes = kill_instead
    if done == 2:
        exchange.sync = lambda path: kill_instead() if len(calls) == 2 else None
    DurableDataset.open(root, REPO_ID).close()
