"""`--wandb.enable=true`, as in lerobot-train: metrics, scores and checkpoints also go to Weights & Biases."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from lerobot.common.wandb_utils import WandBLogger
from lerobot.configs.default import WandBConfig

from relmm.errors import ConfigError

_MODES = ("online", "offline", "disabled")
_STEP, _SCORE = "steps", "eval_"  # the axis of the curves, and how names of scores begin in the metrics


def check_tracking(settings: WandBConfig) -> None:
    """See that a run can be tracked, before it begins.

    Raises:
        ConfigError: there is no such mode, or no account on this machine.
    """
    if settings.mode is not None and settings.mode not in _MODES:
        raise ConfigError(f"wandb.mode is {settings.mode!r}: choose one of {', '.join(_MODES)}.")
    if settings.enable and settings.mode in (None, "online"):
        import wandb

        if not wandb.api.api_key:
            raise ConfigError(
                "--wandb.enable=true needs an account: run `wandb login` first, or say --wandb.mode=offline to send it "
                "later with `wandb sync`."
            )


class Tracker:
    """A run in Weights & Biases; nothing that happens there ends the training.

    Args:
        config: a `relmm.commands.train_config.TrainConfig`.
        settings: of the run, as it keeps them.

    Raises:
        ConfigError: the run cannot be begun there.
    """

    def __init__(self, config: Any, settings: dict[str, Any]) -> None:
        import wandb

        config.output_dir.mkdir(parents=True, exist_ok=True)  # else wandb writes somewhere else
        known = config.wandb.run_id or any(config.output_dir.glob("wandb/latest-run/run-*.wandb"))
        try:
            self._logger = WandBLogger(_as_lerobots(config, settings, resume=config.resume and bool(known)))
        except wandb.errors.Error as error:
            raise ConfigError(
                f"The run cannot be tracked ({' '.join(str(error).split())}): say --wandb.mode=offline, or leave out "
                "--wandb.enable."
            ) from error
        assert wandb.run is not None
        self._run = wandb.run
        self._lost = False

    def log(self, line: dict[str, Any]) -> None:
        """Take a line of the metrics."""
        numbers = {name: value for name, value in line.items() if isinstance(value, int | float)}
        scores = {name.removeprefix(_SCORE): value for name, value in numbers.items() if name.startswith(_SCORE)}
        if scores:
            numbers, mode = {**scores, _STEP: line[_STEP]}, "eval"
        else:
            mode = "train"
        self._try(lambda: self._logger.log_dict(numbers, mode=mode, custom_step_key=_STEP))

    def log_checkpoint(self, checkpoint: Path) -> None:
        """Take a checkpoint, unless `--wandb.disable_artifact=true`."""
        self._try(lambda: self._logger.log_policy(checkpoint))

    def finish(self) -> None:
        """Send what is left, and say where everything is."""
        self._try(self._run.finish)
        url = self._run.url
        print(f"wandb: {url}" if url else f"wandb: send it with `wandb sync {Path(self._run.dir).parent}`")

    def _try(self, job: Callable[[], None]) -> None:
        if self._lost:
            return
        try:
            job()
        except Exception as error:  # whatever it is, the run goes on
            self._lost = True
            logging.getLogger("relmm").warning(
                "wandb: %s; it gets nothing more of this run, which goes on: metrics.jsonl has everything.",
                " ".join(str(error).split()) or type(error).__name__,
            )


def _as_lerobots(config: Any, settings: dict[str, Any], resume: bool) -> Any:
    """What LeRobot's logger reads of the config of lerobot-train."""
    names = ("wandb", "output_dir", "job_name", "policy", "seed", "dataset")
    taken = {name: getattr(config, name) for name in names}
    return SimpleNamespace(**taken, env=None, is_reward_model_training=False, resume=resume, to_dict=lambda: settings)
