"""What the commands share: parsing as LeRobot does, errors in one sentence, stopping on signals."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import sys
import types
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

from tqdm import tqdm

from relmm.commands.arguments import Arguments, said
from relmm.commands.options import bad_choice, listing, unknown_option
from relmm.commands.terminal import lasting
from relmm.errors import ConfigError, RelmmError

_USAGE_ERROR = 2


def run[Config](
    command: str,
    config_class: type[Config],
    job: Callable[[Config], None],
    prepare: Callable[[Arguments], None] = lambda arguments: None,
) -> None:
    """Parse the command line into a config, do the job, and end with a sentence instead of a traceback.

    Args:
        command: its name, for messages.
        config_class: a draccus dataclass; `--policy.path` is understood as in LeRobot.
        job: what to do.
        prepare: may change the arguments before they are parsed.
    """
    with lasting():
        _quiet()
        try:
            _register_plugins()
            arguments = said()
            if arguments.asks_for_any_help:
                print(listing(config_class, arguments))
                return
            prepare(arguments)
            arguments.hand_over()
            job(_parse(config_class, arguments))
        except (RelmmError, OSError, MemoryError) as error:
            print(f"{command}: {_sentence(error)}", file=sys.stderr)
            sys.exit(_USAGE_ERROR)
        except KeyboardInterrupt:
            print(f"{command}: interrupted.", file=sys.stderr)
            sys.exit(128 + signal.SIGINT)


def _register_plugins() -> None:
    from lerobot.utils.import_utils import register_third_party_plugins

    import relmm.plugin  # noqa: F401

    register_third_party_plugins()


def _parse[Config](config_class: type[Config], arguments: Arguments) -> Config:
    """The command line as LeRobot parses it.

    Raises:
        ConfigError: it cannot be understood, or one of our own checks failed.
    """
    from lerobot.configs import parser

    def identity(config: Any) -> Any:
        return config

    identity.__annotations__["config"] = config_class  # where the parser looks for the class
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return parser.wrap()(identity)()
    except SystemExit as stop:
        if not stop.code:
            raise
        # The parser has printed its usage and an error; draccus hides our own checks' words among the causes.
        last_line = messages.getvalue().strip().split("\n")[-1].split("error: ", 1)[-1]
        raise own_error(stop) or ConfigError(_refused(last_line, config_class, arguments)) from stop
    except Exception as error:  # whatever the parser meets, somebody has typed it, or has a file with it
        raise own_error(error) or ConfigError(_sentence(error)) from error


def _refused(words: str, config_class: type, arguments: Arguments) -> str:
    """The parser's words about an option, in ours where they can be told better."""
    _, unknown, options = words.partition("unrecognized arguments: ")
    if unknown:
        return unknown_option(options.split()[0], config_class, arguments)
    return bad_choice(words, config_class, arguments) or f"{words} (--help_all shows what there is)."


def _quiet() -> None:
    """Only our own words on the terminal; warnings of other libraries that a user can do nothing about are left out."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", force=True)
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    logging.getLogger().setLevel(logging.ERROR)
    logging.getLogger("relmm").setLevel(logging.INFO)
    warnings.filterwarnings("ignore", module="(torch|torchvision|datasets|gymnasium).*")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning threads cost more than they give on few cores


def own_error(error: BaseException | None) -> RelmmError | None:
    """Ours among the causes of an error: draccus wraps what a config's checks raise."""
    while error is not None and not isinstance(error, RelmmError):
        error = error.__cause__ or error.__context__
    return error


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def now() -> str:
    """When a run began, to tell it from others with the same settings."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def progress(
    total: int | None, unit: str, title: str | None = None, leave: bool = True, layout: str | None = None
) -> tqdm[NoReturn]:
    """A progress bar; where nobody watches, as in a log file, it says something every ten seconds only."""
    interval = 0.1 if sys.stderr.isatty() else 10.0
    return tqdm(
        total=total, unit=unit, desc=title, leave=leave, mininterval=interval, dynamic_ncols=True, bar_format=layout
    )


class StopOnSignal:
    """Notes the first SIGINT, SIGTERM or SIGHUP instead of dying of it; a second one ends the process as usual.

    Not a second SIGHUP: when a terminal goes away, the kernel and the shell both send one.

    Attributes:
        number: of the signal, None before there is one.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._previous: dict[int, Any] = {}

    @property
    def stopped(self) -> bool:
        """Whether to stop."""
        return self.number is not None

    def __enter__(self) -> StopOnSignal:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._restore(*self._previous)

    def _note(self, number: int, frame: types.FrameType | None) -> None:
        if self.stopped:
            return
        self.number = number
        self._restore(signal.SIGINT, signal.SIGTERM)
        print("\nStopping: saving what there is (once more to stop at once).", file=sys.stderr)

    def _restore(self, *numbers: int) -> None:
        for number in numbers:
            if number in self._previous:
                signal.signal(number, self._previous.pop(number))


def dated_folder(kind: str, name: str) -> Path:
    """outputs/KIND/DATE/TIME_NAME, as LeRobot's commands name their folders."""
    now = datetime.now()
    return Path("outputs") / kind / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{name}"
