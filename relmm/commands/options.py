"""All options of a command: listed for `--help_all`, and searched for what a typo may have meant."""

from __future__ import annotations

import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from types import NoneType
from typing import Any, get_args, get_type_hints

import draccus

from relmm.commands.arguments import Arguments
from relmm.errors import suggestion

_OF_LEROBOT = {  # of LeRobot's own options, which have no docstring to take it from
    "id": "tells robots of one type apart",
    "calibration_dir": "folder of calibration files",
    "device": "of torch: cpu, cuda, mps; LeRobot's choice if not said",
    "push_to_hub": "upload the checkpoint to policy.repo_id",
    "repo_id": "where the checkpoint goes, user/name",
    "private": "whether a new repository is private",
    "tags": "more of them for the card, [a,b]",
    "license": "for the card",
}
_NAME, _WIDTH = 42, 118  # columns
_ENTRY = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*)")


@dataclass(frozen=True)
class Option:
    """One option.

    Attributes:
        name: without the dashes.
        default: as it would be typed; None where there is none.
        help: what it is.
        section: that it is listed under: which type it belongs to.
        choices: all it may be; none where it may be anything.
    """

    name: str
    default: str | None
    help: str
    section: str
    choices: tuple[str, ...] = ()


def options(config_class: type, arguments: Arguments, prefix: str = "", section: str = "") -> Iterator[Option]:
    """Every option of a config, in order; of what has several types the chosen one's, or all.

    Args:
        config_class: a draccus dataclass.
        arguments: of the command line, for the chosen types.
        prefix: of the names.
        section: that they are listed under.
    """
    hints, texts = get_type_hints(config_class), {**_OF_LEROBOT, **_docstrings(config_class)}
    with_path = config_class.__get_path_fields__() if hasattr(config_class, "__get_path_fields__") else []
    for field in (field for field in fields(config_class) if field.init):
        name, kind, text = f"{prefix}{field.name}", _class_of(hints[field.name]), texts.get(field.name, "")
        if kind is not None and issubclass(kind, draccus.ChoiceRegistry):
            known = choices(kind, field)
            yield Option(f"{name}.type", None, text, section, tuple(known))
            if field.name in with_path:
                yield Option(f"{name}.path", None, "folder, or user/repo[@revision]", section)
            chosen = arguments.get(f"{name}.type")
            for choice in [chosen] if chosen in known else known:
                yield from options(known[choice], arguments, f"{name}.", f"--{name}.type={choice}")
        elif kind is not None and is_dataclass(kind):
            yield from options(kind, arguments, f"{name}.", section)
        else:
            yield Option(name, _default(field), text, section)


def choices(kind: Any, field: Field[Any]) -> dict[str, type]:
    """The types that a field may have here: LeRobot registers others, which relmm's commands cannot use."""
    wanted = field.metadata.get("choices", kind)
    known = kind.get_known_choices().items()
    return {name: of for name, of in known if issubclass(of, wanted) and of.__module__.startswith("relmm.")}


def listing(config_class: type, arguments: Arguments) -> str:
    """All options, with their defaults."""
    lines, section = ["  --config_path=FILE  settings, as YAML or JSON; options come on top of them"], ""
    for option in options(config_class, arguments):
        if option.section != section:
            section = option.section
            lines.append(f"\n{section}" if section else "")
        default = "" if option.default is None else f"={option.default}"
        words = option.help if not option.choices else f"{', '.join(option.choices)}: {option.help}"
        start = f"  --{option.name}{default}  "
        lines += textwrap.wrap(start.ljust(_NAME) + words, _WIDTH, subsequent_indent=" " * _NAME) or [start]
    return "\n".join(lines)


def unknown_option(word: str, config_class: type, arguments: Arguments) -> str:
    """A sentence about an option that there is not."""
    name, equals, value = word.partition("=")
    of_policy = f"policy.{name.removeprefix('--')}"
    if arguments.get(of_policy) is not None:  # LeRobot takes the prefix off what comes with --policy.path
        name = f"--{of_policy}"
    known = [f"--{option.name}" for option in options(config_class, arguments)]
    return f"There is no option {name}{equals}{value}{suggestion(name, known)}; --help_all lists what there is."


def bad_choice(words: str, config_class: type, arguments: Arguments) -> str | None:
    """A sentence about a type that there is not, if that is what the parser complains of."""
    for option in options(config_class, arguments):
        if words.startswith(f"argument --{option.name}: invalid choice"):
            value = arguments.get(option.name) or ""
            known = ", ".join(option.choices)
            return f"{option.name} is {value!r}{suggestion(value, option.choices)}: choose one of {known}."
    return None


def _class_of(hint: Any) -> type | None:
    """The class of `X` and `X | None`, if it is one."""
    kinds = [kind for kind in get_args(hint) or (hint,) if kind is not NoneType]
    return kinds[0] if len(kinds) == 1 and isinstance(kinds[0], type) else None


def _default(field: Field[Any]) -> str | None:
    value = field.default if field.default_factory is MISSING else field.default_factory()
    if value is None or value is MISSING or value == {}:
        return None
    encoded = draccus.encode(value)
    if isinstance(encoded, bool | dict | list):
        return json.dumps(encoded)
    return str(encoded)


def _docstrings(config_class: type) -> dict[str, str]:
    """What the `Args:` of a class and its bases say about each field."""
    texts: dict[str, str] = {}
    for base in reversed(config_class.__mro__):
        names: list[str] = []
        _, _, entries = inspect.cleandoc(base.__doc__ or "").partition("Args:\n")
        for line in entries.splitlines():
            entry = _ENTRY.match(line)
            if entry is not None:
                names = entry[1].split(", ")
            for name in names:
                texts[name] = entry[2] if entry is not None else f"{texts[name]} {line.strip()}"
    return texts
