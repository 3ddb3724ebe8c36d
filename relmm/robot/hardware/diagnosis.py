"""Looks at every part of a LoCoBot without moving any, and says for each what to do."""

from __future__ import annotations

import termios
from collections.abc import Callable, Iterator

from relmm.errors import RelmmError, RobotError
from relmm.robot.hardware.config_locobot import LocobotConfig
from relmm.robot.hardware.d435 import HEIGHT, WIDTH, AlignedRealSense, open_camera
from relmm.robot.hardware.kobuki import Kobuki
from relmm.robot.hardware.kobuki_protocol import BATTERY_LOW, Charger
from relmm.robot.hardware.motors import BAUD_RATE, FACTORY_BAUD_RATE, JOINTS, LocobotMotorsBus
from relmm.robot.hardware.ports import find_port
from relmm.robot.hardware.widowx import MAX_TEMPERATURE, NO_SDK, error_words

_VOLTAGE = (9.5, 14.8)  # V at which the motors work
_SILENT = (ConnectionError, OSError, RuntimeError, termios.error, IndexError)


def hardware_checks(config: LocobotConfig) -> Iterator[tuple[str, Callable[[], str]]]:
    """Checks by name, each to be called once, in this order; they raise `RelmmError` with what to do."""
    yield "base", lambda: check_base(config)
    motors = _Motors(config)
    yield "arm", motors.open
    for name in JOINTS:
        yield name, lambda name=name: motors.check(name)  # type: ignore[misc]
    motors.close()
    yield "camera", lambda: check_camera(config)


def check_base(config: LocobotConfig) -> str:
    """Whether it answers, stands on the floor, and is charged."""
    port = find_port("base", config.base_port)
    base = Kobuki(port, dry=True)
    try:
        base.wait_until_there()
        version, state = base.firmware(), base.state()
    finally:
        base.close()
    if state.wheel_drop or state.cliff or state.bumper:
        raise RobotError(
            f"The base on {port} says that a wheel hangs ({state.wheel_drop}), that it stands at an edge "
            f"({state.cliff}) or that its bumper is pressed ({state.bumper}): put it on the floor, away from things."
        )
    if state.battery < BATTERY_LOW:
        raise RobotError(f"The battery is at {state.battery:.1f} V, below {BATTERY_LOW} V: charge it.")
    firmware = "unknown" if version is None else ".".join(map(str, version))
    charging = "" if state.charger == Charger.NONE else ", charger plugged in: pull it out before you drive"
    return f"Kobuki on {port}, firmware {firmware}, battery {state.battery:.1f} V{charging}"


class _Motors:
    """The chain of motors, asked one by one."""

    def __init__(self, config: LocobotConfig) -> None:
        self._config = config
        self._bus: LocobotMotorsBus | None = None

    def open(self) -> str:
        """Open the adapter."""
        port = find_port("arm", self._config.arm_port)
        try:
            bus = LocobotMotorsBus(port)
            bus.connect(handshake=False)
            bus.set_baudrate(BAUD_RATE)
        except ImportError as error:
            raise RobotError(NO_SDK) from error
        except _SILENT as error:
            raise RobotError(
                f"{port} cannot be opened: plug the arm's adapter in, close other programs that use it, and see that "
                "you are in the group dialout."
            ) from error
        self._bus = bus
        return f"adapter on {port}"

    def check(self, name: str) -> str:
        """Whether a motor answers, at which rate, and how it is."""
        bus, joint = self._bus, JOINTS[name]
        if bus is None:
            raise RelmmError("not asked: the adapter is missing.")
        try:
            model = bus.ping(name)
            if model is None:
                self._find_at_factory_rate(bus, name)
            if model != bus.model_number_table[joint.model]:
                raise RobotError(
                    f"Motor {joint.id} is of model {model}, and {joint.model} is wanted here: check wiring and ids."
                )
            return self._health(bus, name)
        except _SILENT as error:
            raise RobotError(f"Motor {joint.id} does not answer well ({error}): check its cables.") from error

    def _find_at_factory_rate(self, bus: LocobotMotorsBus, name: str) -> None:
        number = JOINTS[name].id
        bus.set_baudrate(FACTORY_BAUD_RATE)
        found = bus.ping(name)
        bus.set_baudrate(BAUD_RATE)
        if found is not None:
            raise RobotError(
                f"Motor {number} answers at {FACTORY_BAUD_RATE:,} baud only, as it comes from the factory: set its "
                "Baud_Rate to 1,000,000, with Dynamixel Wizard."
            )
        raise RobotError(
            f"Motor {number} does not answer at {BAUD_RATE:,} nor at {FACTORY_BAUD_RATE:,} baud: is the arm's power "
            "on, and is each motor's cable in?"
        )

    def _health(self, bus: LocobotMotorsBus, name: str) -> str:
        def read(register: str) -> int:
            # Not `bus.read`, which fails where a motor reports an error, and here that is the answer.
            address, length = bus.model_ctrl_table[JOINTS[name].model][register]
            return int(bus._read(address, length, JOINTS[name].id, num_retry=2, raise_on_error=False)[0])

        volts, warm, error = (
            read("Present_Input_Voltage") / 10,
            read("Present_Temperature"),
            read("Hardware_Error_Status"),
        )
        if error:
            raise RobotError(
                f"Motor {JOINTS[name].id} has switched itself off ({error_words(error)}): free what is stuck, and "
                "switch the robot off and on."
            )
        if not _VOLTAGE[0] <= volts <= _VOLTAGE[1]:
            raise RobotError(f"Motor {JOINTS[name].id} gets {volts:.1f} V, and 12 V are right: check the arm's power.")
        if warm > MAX_TEMPERATURE:
            raise RobotError(f"Motor {JOINTS[name].id} is at {warm} degrees C: let it cool down.")
        return f"motor {JOINTS[name].id}, {JOINTS[name].model}, {volts:.1f} V, {warm} degrees C"

    def close(self) -> None:
        """Let go of the adapter."""
        if self._bus is not None:
            self._bus.disconnect(disable_torque=False)


def check_camera(config: LocobotConfig) -> str:
    """Whether it is there, at the speed of USB 3, and sends pictures."""
    camera = open_camera(config.camera_serial)
    try:
        number, lens = camera.serial_number, camera.intrinsics()
    finally:
        camera.disconnect()
    usb = next(str(c["usb_type_descriptor"]) for c in AlignedRealSense.find_cameras() if str(c["id"]) == number)
    if not usb.startswith("3"):
        raise RobotError(f"The camera is plugged into USB {usb}, which is too slow for colour and depth: use USB 3.")
    return f"RealSense {number} on USB {usb}, {WIDTH}x{HEIGHT}, focal length {lens[0]:.0f} pixels"
