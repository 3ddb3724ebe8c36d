"""The dataset card, made from the dataset itself."""

from __future__ import annotations

from typing import Any

from huggingface_hub import DatasetCard, DatasetCardData

from relmm.episodes.folder import INFO, RELMM, DatasetFolder
from relmm.episodes.info import runs_of
from relmm.episodes.summary import DatasetSummary, summarize
from relmm.features import ACTION_NAMES, DATASET_COLUMNS, FPS, JOINT_NAMES, MAX_THETA_VEL, MAX_X_VEL, Phase
from relmm.geometry import describe_camera

CONTACT_SHEET = "contact_sheet.png"
_LEROBOT = "https://github.com/huggingface/lerobot"
_PHASES = {
    Phase.CURRICULUM: "the policy practised grasping",
    Phase.LEARNING: "the policy acted",
    Phase.PSEUDO_RESET: "a random walk carried the object elsewhere and put it down",
    Phase.EVALUATION: "the policy was evaluated",
    Phase.TELEOPERATION: "a person had taken over",
}
_EPISODES = {  # by what a run says of itself; LeRobot's own recorder says nothing
    "practice": "An episode goes from the pseudo-reset after one success to the next success, or to a step limit.",
    "clean": "An episode is one room, until all its objects are in the basket, or to a step limit.",
}
CITATION = """```bibtex
@inproceedings{sun2021relmm,
  title     = {Fully Autonomous Real-World Reinforcement Learning with Applications to Mobile Manipulation},
  author    = {Sun, Charles and Orbik, J{\\k{e}}drzej and Devin, Coline Manon and Yang, Brian H. and Gupta, Abhishek
               and Berseth, Glen and Levine, Sergey},
  booktitle = {Conference on Robot Learning},
  year      = {2021}
}
```"""


def dataset_card(folder: DatasetFolder, repo_id: str, license: str, contact_sheet: bool) -> DatasetCard:
    """The README.md of a dataset.

    Args:
        folder: the dataset as it is uploaded.
        repo_id: its name, `user/name`.
        license: identifier of the Hub.
        contact_sheet: whether there is a `contact_sheet.png` beside it.
    """
    info, own = folder.read_json(INFO) or {}, folder.read_json(RELMM) or {}
    summary = summarize(folder.root)
    data = DatasetCardData(
        license=license,
        task_categories=["robotics"],
        tags=["LeRobot", "relmm", "mobile-manipulation", str(info.get("robot_type"))],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    sections = [
        f"---\n{data.to_yaml()}\n---",
        _head(repo_id, info, {run.get("mode", "practice") for run in own.get("runs", [])}, contact_sheet),
        "## What is in it\n\n" + _counts(summary),
        "## Who acted\n\n" + _who(summary),
        "## Columns\n\n" + _columns(info["features"]),
        "## How it was recorded\n\n" + _runs(runs_of(own)),
        "## Use\n\n" + _use(repo_id),
        f"## Licence and citation\n\nLicence: {license}. The method:\n\n{CITATION}",
    ]
    return DatasetCard("\n\n".join(sections) + "\n", ignore_metadata_errors=False)


def _head(repo_id: str, info: dict[str, Any], modes: set[str], contact_sheet: bool) -> str:
    sheet = f"\n\n![Pictures of the dataset]({CONTACT_SHEET})\n*What the robot does next, episode:frame.*"
    sheet = sheet if contact_sheet else ""
    return f"""# {repo_id}

The life of a LoCoBot ({info.get("robot_type")}) that picks things up in a room, recorded with `relmm`, a
[LeRobot]({_LEROBOT}) package of ReLMM, as a LeRobot {info.get("codebase_version")} dataset.
{" ".join(_EPISODES[mode] for mode in sorted(modes & _EPISODES.keys()))}
A frame is one blocking skill: what the robot saw before it, what it then did, and how that ended.{sheet}"""


def _counts(summary: DatasetSummary) -> str:
    rate = f"{summary.successful_grasps / summary.grasps:.1%}" if summary.grasps else "no attempts"
    rows = {
        "episodes": f"{summary.episodes}: {summary.ended_by_success} ended by success, {summary.truncated} cut off",
        "frames": f"{summary.frames} ({FPS} per second as LeRobot plays them)",
        "time on the robot's clock": f"{summary.robot_seconds / 60:.1f} min",
        "grasp attempts": str(summary.grasps),
        "of them successful": f"{summary.successful_grasps} ({rate})",
    }
    return table(("what", "how many"), rows.items())


def _who(summary: DatasetSummary) -> str:
    rows = [
        (f"`{int(phase)}` {phase.name.lower().replace('_', ' ')}", _PHASES[phase], str(frames))
        for phase, frames in summary.frames_by_phase.items()
    ]
    return "By `complementary_info.phase`:\n\n" + table(("phase", "who, and why", "frames"), rows)


def _columns(features: dict[str, Any]) -> str:
    rows = [
        (f"`{key}`", f"{feature['dtype']} {tuple(feature['shape'])}", _meaning(key, feature))
        for key, feature in features.items()
    ]
    names = f"`{'`, `'.join(ACTION_NAMES[:2])}` reach {MAX_X_VEL} m/s and {MAX_THETA_VEL} deg/s. Joints in degrees: "
    return table(("column", "type", "meaning and unit"), rows) + f"\n\n{names}`{'`, `'.join(JOINT_NAMES)}`."


def _meaning(key: str, feature: dict[str, Any]) -> str:
    info = feature.get("info")
    camera = info.get("camera") if isinstance(info, dict) else None
    seen_by = "" if camera is None else f"; camera {describe_camera(camera)}: m in the robot's frame, degrees"
    return DATASET_COLUMNS.get(key, "LeRobot's own") + seen_by


def _runs(runs: list[dict[str, Any]]) -> str:
    if not runs:
        return "By LeRobot's own recorder; nothing more is known."
    keys = list(dict.fromkeys(key for run in runs for key in run))
    rows = [tuple("" if run.get(key) is None else str(run[key]) for key in keys) for run in runs]
    return table(tuple(key.replace("_", " ") for key in keys), rows)


def _use(repo_id: str) -> str:
    return f"""```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{repo_id}")
```

Train on it with `relmm` installed: `relmm-train --robot.type=locobot_sim --dataset.init={repo_id}`."""


def table(head: tuple[str, ...], rows: Any) -> str:
    """A table in Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
