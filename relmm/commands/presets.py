"""The presets that are shipped with relmm, by name."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

from relmm.errors import ConfigError
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig

PRESETS = ("paper", "paper_small")
_OPTION = "--config_path="


def preset_path(name: str) -> Path:
    """The file of a preset."""
    return Path(str(files("relmm.policies.relmm_paper"))) / "presets" / f"{name}.json"


def load_preset(name: str) -> RelmmPaperConfig:
    """A preset as a policy's config."""
    settings = json.loads(preset_path(name).read_text(encoding="utf-8"))["policy"]
    settings.pop("type")
    return RelmmPaperConfig(**settings)


def resolve_config_path(arguments: list[str]) -> None:
    """Replace a preset's name after `--config_path=` by its file; a resumed run takes the settings of its checkpoint.

    Args:
        arguments: of the command line; changed in place.

    Raises:
        ConfigError: no such file, or a preset and a checkpoint, which has its own settings.
    """
    for index, argument in enumerate(arguments):
        name = argument.removeprefix(_OPTION)
        if name in PRESETS and argument.startswith(_OPTION):
            checkpoint = next((a for a in arguments if a.startswith("--policy.path=")), None)
            if checkpoint is not None:
                raise ConfigError(
                    f"{argument} begins a new policy and {checkpoint} goes on with another, by its own settings: leave "
                    "one of them out."
                )
            arguments[index] = f"{_OPTION}{preset_path(name)}"
        elif argument.startswith(_OPTION) and not Path(name).is_file():
            raise ConfigError(f"{argument}: there is no such file; choose one, or a preset: {', '.join(PRESETS)}.")
    folder = next((a.partition("=")[2] for a in arguments if a.startswith("--output_dir=")), None)
    if "--resume=true" in arguments and folder and not any(a.startswith(_OPTION) for a in arguments):
        stored = Path(folder) / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        if stored.is_file():
            arguments.append(f"{_OPTION}{stored}")
