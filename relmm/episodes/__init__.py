"""Durable LeRobot datasets: recording, resuming, repairing and counting them."""

from relmm.episodes.frames import FrameBuilder
from relmm.episodes.recorder import EpisodeRecorder
from relmm.episodes.repair import RepairReport, verify_and_repair
from relmm.episodes.settings import check_new, check_repo_id, check_resume
from relmm.episodes.summary import DatasetSummary, summarize
from relmm.episodes.writer import DurableDataset

__all__ = [
    "DatasetSummary",
    "DurableDataset",
    "EpisodeRecorder",
    "FrameBuilder",
    "RepairReport",
    "check_new",
    "check_repo_id",
    "check_resume",
    "summarize",
    "verify_and_repair",
]
