"""The model card of a checkpoint, made from its run: settings, metrics and dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lerobot
from huggingface_hub import ModelCard, ModelCardData

from relmm.episodes import UploadedDataset
from relmm.episodes.card import CITATION, table
from relmm.features import (
    GRASP_X,
    GRASP_Y,
    IMAGE_SIZE,
    MAX_THETA_VEL,
    MAX_X_VEL,
    NAVIGATION_STEP_S,
    SCAN_NAMES,
    STATE_NAMES,
)
from relmm.geometry import camera_geometry
from relmm.learning.hub import CURVE
from relmm.learning.progress import read_metrics

_INSTALL = (
    "pip install -e PATH_TO_A_CHECKOUT_OF_RELMM  # the plugin first: `lerobot_policy_relmm`, or nothing loads this"
)


@dataclass(frozen=True)
class ModelFacts:
    """What a card is made from.

    Attributes:
        repo_id: of the model, `user/name`.
        settings: of the run, the content of `train_config.json`.
        metrics: of the run, a `metrics.jsonl`.
        dataset: what it was trained on; None if that is not shared.
        license: identifier of the Hub.
        tags: more than the usual.
    """

    repo_id: str
    settings: dict[str, Any]
    metrics: Path
    dataset: UploadedDataset | None
    license: str
    tags: tuple[str, ...] = ()


def model_card(facts: ModelFacts) -> ModelCard:
    """The README.md of a model."""
    lines = read_metrics(facts.metrics) if facts.metrics.is_file() else []
    data = ModelCardData(
        library_name="lerobot",
        pipeline_tag="robotics",
        license=facts.license,
        tags=["robotics", "lerobot", "relmm", "reinforcement-learning", "mobile-manipulation", *facts.tags],
        datasets=[facts.dataset.repo_id] if facts.dataset else None,
    )
    sections = [
        f"---\n{data.to_yaml()}\n---",
        _head(facts),
        "## Room and camera\n\n" + _room(facts.settings),
        "## Inputs and outputs\n\n" + _interface(),
        "## Results\n\n" + _results(facts.settings, lines),
        "## Training\n\n" + _training(facts, lines),
        "## Use\n\n" + _use(facts),
        "## Limits\n\n" + _LIMITS,
        f"## Licence and citation\n\nLicence: {facts.license}. The method:\n\n{CITATION}",
    ]
    return ModelCard("\n\n".join(sections) + "\n", ignore_metadata_errors=False)


_ENSEMBLE = "an ensemble of networks says where a grasp would succeed, a gate decides whether to try, and"
_METHODS = {
    "relmm": f"{_ENSEMBLE} ways to where it would are planned over the floor that it remembers",
    "relmm_paper": f"{_ENSEMBLE} soft actor-critic navigates to where it would",
    "relmm_single": "one soft actor-critic decides at every step whether to drive or to grasp, and where (the paper's "
    "ablation of its hierarchy)",
}


def _method(policy: dict[str, Any]) -> str:
    """How a policy works; baselines are named as such."""
    if policy.get("navigation") == "random":
        return f"{_ENSEMBLE} it drives about at random (the paper's baseline Rand nav)"
    return _METHODS[policy["type"]]


def _head(facts: ModelFacts) -> str:
    kind = facts.settings["policy"]["type"]
    return f"""# {facts.repo_id}

A policy `{kind}` that drives a LoCoBot about a room and picks things up, learned online from scratch with `relmm`, a
[LeRobot](https://github.com/huggingface/lerobot) package of ReLMM: {_method(facts.settings["policy"])}.
Rewards come from the robot's own sensors; no demonstrations, no reset, no map is given."""


def _room(settings: dict[str, Any]) -> str:
    robot = settings.get("robot") or {}
    name = settings["policy"]["camera"]
    camera = camera_geometry(name)
    forward, left, up = camera.position
    width, height = camera.fov
    geometry = (
        f"{up} m high, {forward} m forward and {left} m left of the robot's centre, {camera.pitch} degrees down, "
        f"field of view {width} x {height} degrees"
    )
    rows = [("robot", "one whose life was recorded by another process; see the dataset")]
    if robot:
        rows = [
            ("robot", f"`{robot['type']}`"),
            ("room", f"`{robot.get('room', 'a real one')}`"),
            ("objects", str(robot.get("num_objects") or "the room's own number")),
        ]
    return table(("what", "which"), [*rows, ("camera", f"`{name}`: {geometry}")])


def _interface() -> str:
    x, y = (f"{low} to {high} m" for low, high in (GRASP_X, GRASP_Y))
    rows = [
        ("in", "`observation.images.front`", f"{IMAGE_SIZE}x{IMAGE_SIZE} RGB"),
        (
            "in",
            "`observation.state`",
            f"{len(STATE_NAMES)} numbers: base motion (m/s, deg/s), arm joints (deg), gripper (m), holding, bumper, "
            f"distances to what stands in {len(SCAN_NAMES)} directions (m)",
        ),
        ("out", "`x.vel`, `theta.vel`", f"0 to {MAX_X_VEL} m/s forward, up to {MAX_THETA_VEL} deg/s (positive = left)"),
        ("out", "`skill.pos`", "0 navigate, 1 grasp, 2 place"),
        (
            "out",
            "`skill_x.pos`, `skill_y.pos`",
            f"where to grasp or place, m in the robot's frame: {x} forward, {y} left",
        ),
    ]
    return (
        table(("", "name", "what"), rows) + "\n\nOne action is one blocking skill; a navigation step "
        f"takes {NAVIGATION_STEP_S} s."
    )


def _results(settings: dict[str, Any], lines: list[dict[str, Any]]) -> str:
    evaluations = [line for line in lines if "eval_collected" in line]
    if not evaluations:
        return "The run was not evaluated."
    seeds = [settings["eval"]["seed"] + index for index in range(len(evaluations[-1]["eval_collected_each"]))]
    rows = [
        (
            str(line["steps"]),
            f"{line['eval_collected']:.1%} ± {line['eval_collected_std']:.1%}",
            ", ".join(f"{share:.0%}" for share in line["eval_collected_each"]),
            f"{line['eval_grasp_success']:.1%}",
        )
        for line in evaluations
    ]
    head = (
        "navigation steps",
        "objects collected",
        f"each, of seed {', '.join(map(str, seeds))}",
        "grasps that succeed",
    )
    return (
        "Episodes of 250 navigation steps in the room it was trained in, greedily and without pseudo-resets; mean ± "
        f"standard deviation over the episodes. One training run, of seed {settings['seed']}.\n\n" + table(head, rows)
    )


def _training(facts: ModelFacts, lines: list[dict[str, Any]]) -> str:
    settings = facts.settings
    head = (
        f"Curriculum `{settings['curriculum']['type']}`, seed {settings['seed']}, LeRobot {lerobot.__version__}; "
        f"all settings are in `train_config.json`, all metrics in `metrics.jsonl`. {_learned_from(facts)}"
    )
    if not lines:
        return head
    last = lines[-1]
    return (
        f"{head} So far: {last['steps']} navigation steps, {last['pseudo_reset_steps']} more in pseudo-resets, "
        f"{last['attempts']} grasp attempts of which {last['successes']} succeeded, {last['objects']} objects "
        f"picked up outside the curriculum, in {last['robot_minutes']:.0f} minutes of the robot's time; objects that a "
        f"person put into reach: {last['interventions']}.\n\n"
        f"![Learning curve: objects collected in evaluations, and training]({CURVE})"
    )


def _learned_from(facts: ModelFacts) -> str:
    if facts.dataset is None:
        return "Its dataset is not shared, so training cannot go on from here."
    name, init = facts.dataset.repo_id, facts.settings["dataset"].get("init")
    link = f"[{name}](https://huggingface.co/datasets/{name}), revision `{facts.dataset.revision}`"
    begun = f", and in `{init}`, from which it began" if init else ""
    return f"What it has learned from is in {link}{begun}."


def _use(facts: ModelFacts) -> str:
    robot, camera = facts.settings.get("robot") or {}, facts.settings["policy"]["camera"]
    room = robot.get("room", "no_obstacles")
    body = f"--robot.type=locobot_sim --robot.room={room} --robot.camera={camera} --policy.path={facts.repo_id}"
    resume = f"""
# go on training, with its dataset
relmm-train --resume=true --policy.path={facts.repo_id} --output_dir=outputs/train/continued --steps=STEPS_IN_ALL
"""
    return f"""```bash
{_INSTALL}

# evaluate
relmm-eval --policy.path={facts.repo_id} --env.room={room} --env.camera={camera}
{resume if facts.dataset else ""}
# roll out, and record
lerobot-rollout {body} \\
    --fps=2 --task="clean the room" --duration=60
relmm-record {body} \\
    --dataset.repo_id=me/rollouts --dataset.num_episodes=10
```"""


_LIMITS = """- Trained in simulation, in one room with one camera geometry; another camera needs another training.
- It knows what it can pick up by trying; what it has never met, it may ignore or try in vain.
- It does not know people, animals, stairs or fragile things: supervise it on a real robot."""
