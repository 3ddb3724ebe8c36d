"""The presets that are shipped with relmm, by name."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

from relmm.commands.arguments import Arguments
from relmm.errors import ConfigError, suggestion
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig

PRESETS = ("paper", "paper_small", "paper_continuous")


def preset_path(name: str) -> Path:
    """The file of a preset."""
    return Path(str(files("relmm.policies.relmm_paper"))) / "presets" / f"{name}.json"


def load_preset(name: str) -> RelmmPaperConfig:
    """A preset as a policy's config."""
    settings = json.loads(preset_path(name).read_text(encoding="utf-8"))["policy"]
    settings.pop("type")
    return RelmmPaperConfig(**settings)


def resolve_config_path(arguments: Arguments) -> None:
    """Replace a preset's name after `--config_path=` by its file; a resumed run takes the settings of its checkpoint.

    Args:
        arguments: of the command line; changed in place.

    Raises:
        ConfigError: no such file, or a preset and a checkpoint, which has its own settings.
    """
    name, checkpoint = arguments.get("config_path"), arguments.get("policy.path")
    if name in PRESETS:
        if checkpoint is not None:
            raise ConfigError(
                f"--config_path={name} begins a new policy and --policy.path={checkpoint} goes on with another, by its "
                "own settings: leave one of them out."
            )
        arguments.set("config_path", preset_path(name))
    elif name is not None and not Path(name).is_file():
        raise ConfigError(
            f"--config_path={name}: there is no such file{suggestion(name, PRESETS)}; choose one, or a preset: "
            f"{', '.join(PRESETS)}."
        )
    folder = arguments.get("output_dir")
    if name is None and folder and arguments.is_true("resume"):
        stored = Path(folder) / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        if stored.is_file():
            arguments.set("config_path", stored)
