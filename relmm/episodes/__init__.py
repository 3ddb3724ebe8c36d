"""Durable LeRobot datasets: recording, resuming, repairing, counting, reading and following them."""

from relmm.episodes.follow import MAX_STEPS, Episode, EpisodeFollower, read_episodes
from relmm.episodes.frames import FrameBuilder
from relmm.episodes.hub import local_root
from relmm.episodes.recorder import EpisodeRecorder
from relmm.episodes.repair import RepairReport, verify_and_repair
from relmm.episodes.settings import check_new, check_repo_id, check_resume, check_trainable
from relmm.episodes.summary import DatasetSummary, saved_episodes, summarize
from relmm.episodes.upload import UploadedDataset, upload_dataset
from relmm.episodes.writer import DurableDataset

__all__ = [
    "MAX_STEPS",
    "DatasetSummary",
    "DurableDataset",
    "Episode",
    "EpisodeFollower",
    "EpisodeRecorder",
    "FrameBuilder",
    "RepairReport",
    "UploadedDataset",
    "check_new",
    "check_repo_id",
    "check_resume",
    "check_trainable",
    "local_root",
    "read_episodes",
    "saved_episodes",
    "summarize",
    "upload_dataset",
    "verify_and_repair",
]
