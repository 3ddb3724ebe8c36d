"""The command line in one spelling, for the few decisions that come before LeRobot's parser.

The parser takes `--name=value` and `--name value`, the last of several, and booleans as YAML writes them. Whoever
looks for one spelling overlooks the others, so nobody else reads `sys.argv`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

HELP, HELP_ALL = ("-h", "--help"), "--help_all"


class Arguments:
    """Options of a command line, each once, as `--name=value`.

    Args:
        words: as typed, without the command.
    """

    def __init__(self, words: Sequence[str]) -> None:
        self._words: dict[str, str] = {}  # by what comes before the `=`
        rest = list(words)
        while rest:
            word = rest.pop(0)
            name, equals, _ = word.partition("=")
            if _takes_value(name) and not equals and rest and not rest[0].startswith("--") and rest[0] not in HELP:
                word = f"{name}={rest.pop(0)}"
            self._words.pop(name, None)  # the last one counts
            self._words[name] = word

    @property
    def words(self) -> list[str]:
        """All of them, as LeRobot's parser takes them."""
        return list(self._words.values())

    @property
    def asks_for_help(self) -> bool:
        """Whether `--help` is among them."""
        return any(word in self._words for word in HELP)

    @property
    def asks_for_any_help(self) -> bool:
        """Whether `--help_all` or `--help` is among them."""
        return HELP_ALL in self._words or self.asks_for_help

    def get(self, name: str) -> str | None:
        """The value of an option, None if it was not said."""
        word = self._words.get(f"--{name}", "")
        return word.partition("=")[2] if "=" in word else None

    def is_true(self, name: str) -> bool:
        """Whether an option was said to be true, in any spelling that the parser takes."""
        from draccus.cfgparsing import parse_string

        value = self.get(name)
        parsed = None if value is None else parse_string(value)
        return parsed is True or parsed == "true"

    def set(self, name: str, value: object) -> None:
        """Say an option, or say it anew."""
        self._words[f"--{name}"] = f"--{name}={value}"

    def remove(self, name: str) -> None:
        """Take an option back."""
        del self._words[f"--{name}"]

    def hand_over(self) -> None:
        """Make them what LeRobot's parser reads."""
        sys.argv[1:] = self.words


def said() -> Arguments:
    """What the user has typed, and after `Arguments.hand_over` what was made of it."""
    return Arguments(sys.argv[1:])


def _takes_value(name: str) -> bool:
    return name.startswith("--") and name not in (*HELP, HELP_ALL)
