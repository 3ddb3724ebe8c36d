"""The real LoCoBot as a LeRobot `Robot`."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from relmm.errors import RobotError
from relmm.geometry import camera_geometry
from relmm.robot.hardware.body import LocobotBody
from relmm.robot.hardware.calibration import Calibration, load_calibration, save_calibration
from relmm.robot.hardware.config_locobot import LocobotConfig
from relmm.robot.hardware.d435 import D435
from relmm.robot.hardware.guided import STEPS, ask
from relmm.robot.hardware.kobuki import Kobuki
from relmm.robot.hardware.ports import find_port
from relmm.robot.hardware.widowx import WidowX
from relmm.robot.locobot import LocobotRobot

logger = logging.getLogger(__name__)


class Locobot(LocobotRobot):
    """A LoCoBot on the floor of a real room."""

    config_class = LocobotConfig
    name = "locobot"

    def __init__(self, config: LocobotConfig) -> None:
        self.measured = Calibration()  # before LeRobot's constructor, which loads the file if there is one
        super().__init__(config, depth=config.depth, seed=config.seed or 0)
        self.config = config

    # --- Calibration -------------------------------------------------------------------------------------
    @property
    def is_calibrated(self) -> bool:
        """Whether it was measured; without, the numbers of the drawings are used."""
        return bool(self.calibration_fpath.is_file())

    def calibrate(self) -> None:
        """Guide a person at the terminal through all measurements; `lerobot-calibrate` calls this.

        Raises:
            ConfigError: nobody is there.
            RobotError: something could not be measured; what was measured before is saved.
        """
        self.measure(list(STEPS))

    def measure(self, names: Sequence[str]) -> None:
        """Go through some of `STEPS`; what one has found is saved and used before the next one.

        Raises:
            ConfigError, RobotError: as `calibrate`.
        """
        for number, name in enumerate(names, 1):
            step = STEPS[name]
            ask(f"{number}/{len(names)} {name}. {step.prepare}")
            self.disconnect()
            with self:
                values = step.measure(self.body, self.measured)
            self.measured = replace(self.measured, **values)
            self._save_calibration()
            print(f"  {', '.join(f'{key} = {value}' for key, value in values.items())}")
        print(f"saved in {self.calibration_fpath}")

    def _load_calibration(self, fpath: Path | None = None) -> None:
        self.measured = load_calibration(fpath or self.calibration_fpath)

    def _save_calibration(self, fpath: Path | None = None) -> None:
        save_calibration(self.measured, fpath or self.calibration_fpath)

    # --- Connection --------------------------------------------------------------------------------------
    def connect(self, calibrate: bool = True) -> None:
        """Find and check everything, take hold of the arm, and fold it.

        Raises:
            RobotError: something is missing or broken; says what to do. Nothing moves then.
        """
        if not self.is_calibrated:
            logger.warning("This LoCoBot has not been calibrated: run relmm-calibrate --robot.type=locobot first.")
        try:
            super().connect(calibrate)
        except BaseException:
            self.disconnect()  # what was opened before it failed
            raise

    def make_body(self) -> LocobotBody:
        """Open the three devices; what was opened is closed if a later one fails."""
        config, measured = self.config, self.measured
        view = camera_geometry(config.camera)
        base_port, arm_port = find_port("base", config.base_port), find_port("arm", config.arm_port)
        _need_serial()
        with contextlib.ExitStack() as opened:
            base = Kobuki(base_port, measured.wheel_scale, config.dry_run)
            opened.callback(base.close)
            base.wait_until_there()
            arm = WidowX(arm_port, measured.sag_array(), measured.closed_opening, measured.arm_delay, config.dry_run)
            opened.callback(arm.close)
            camera = D435(config.camera_serial, view, measured.camera_pitch, measured.latency)
            opened.callback(camera.close)
            body = LocobotBody(base, arm, camera, view, measured, _print if config.dry_run else None)
            body.start()
            opened.pop_all()
        return body

    @property
    def needs_charging(self) -> bool:
        """See `LocobotRobot`."""
        return self.body.needs_charging

    def await_charge(self, should_stop: Callable[[], bool]) -> None:
        """See `LocobotRobot`."""
        self.body.await_charge(should_stop)
        self.skills.rest()
        self.skills.forget_picture()

    @property
    def body(self) -> LocobotBody:
        """The connected body."""
        body = super().body
        assert isinstance(body, LocobotBody)
        return body


def _need_serial() -> None:
    try:
        import serial  # noqa: F401
    except ImportError as error:
        raise RobotError("A LoCoBot needs pyserial: pip install 'lerobot_policy_relmm[hardware]'.") from error


def _print(what: str) -> None:
    print(f"would {what}")
