"""What test processes do before they are killed. They are imported by name, which test files are not."""

import os
import resource
import signal

from episode_helpers import REPO_ID, record

from relmm.episodes import DurableDataset
from relmm.errors import DatasetError


def die_at_rename(root, saved, number, before):
    """Save two more episodes, and be killed at a rename of the second."""
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(saved, saved + 1))
        replace, calls = os.replace, []

        def replace_and_die(source, target):
            calls.append(target)
            if len(calls) == number and before:
                os.kill(os.getpid(), signal.SIGKILL)
            replace(source, target)
            if len(calls) == number:
                os.kill(os.getpid(), signal.SIGKILL)

        os.replace = replace_and_die
        record(dataset, range(saved + 1, saved + 2))


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
            assert "cannot be written (" in str(error), error
            assert "1 episodes are saved and whole" in str(error), error
            os._exit(7)
