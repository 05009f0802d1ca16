"""The arguments of the subcommands of `steerbench`; commands.toml lists and explains these."""

from __future__ import annotations

import argparse
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

_FILE: dict[str, dict[str, Any]] = tomllib.loads(
    (Path(__file__).parent / "commands.toml").read_text(encoding="utf-8")
)
_SHARED = _FILE.pop("shared")
COMMANDS = _FILE
"""What commands.toml says of each command, by name."""


def count(text: str) -> int:
    """A whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {text}")
    return int(text)


def positive(text: str) -> float:
    """A finite number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return number


def port(text: str) -> int:
    """The number of a port."""
    number = count(text)
    if number > 65535:
        raise argparse.ArgumentTypeError(f"expected at most 65535, got {text}")
    return number


def config_dir(text: str) -> str:
    """`--config-dir=` and the folder `text`, which must exist; `sweeps.overrides` reads it."""
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(f"expected a folder, there is none at {text}")
    return f"--config-dir={Path(text).resolve()}"


SEVERAL = {"action": "append", "default": []}
TYPES: dict[str, dict[str, Any]] = {
    "path": {"type": Path},
    "count": {"type": count, "metavar": "N"},
    "positive": {"type": positive},
    "port": {"type": port},
    "flag": {"action": "store_true"},
    "several": SEVERAL,
    "folders": {**SEVERAL, "type": config_dir},
}
"""The options of argparse for each `type` of an argument."""


def add_commands(parser: argparse.ArgumentParser) -> None:
    """Add all commands to `parser`.

    The parsed arguments hold the name of the `command`, None if there was none, and the innermost
    `parser`.
    """
    parser.set_defaults(command=None, parser=parser)
    commands = parser.add_subparsers(prog=parser.prog, help=argparse.SUPPRESS)
    for name, about in COMMANDS.items():
        below = commands.add_parser(name, description=about["description"])
        below.set_defaults(command=name, parser=below)
        for argument, options in _arguments(about):
            below.add_argument(argument, **options)


def _arguments(about: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The name and the options, as for `add_argument`, of each argument of a command."""
    include = about.get("include", [])
    if usual := about.get("settings"):
        include = [*include, "folder"]
    for group in (about.get("arguments", {}), *(_SHARED[name] for name in include)):
        for name, options in group.items():
            kind = TYPES[options["type"]] if "type" in options else {}
            own = {key: value for key, value in options.items() if key != "type"}
            more = "; may be repeated" if kind.get("action") == "append" else ""
            more += f" (default {own['default']})" if own.get("default") else ""
            yield name, {**kind, **own, "help": own["help"] + more}
    if usual:  # last, because it takes all words that are left
        help = f"settings as of `steerbench run` (default {usual})"
        yield "overrides", {"help": help, "nargs": "*"}


def overview() -> str:
    """All commands by group, one line each."""
    groups: dict[str, list[str]] = {}
    for name, about in COMMANDS.items():
        groups.setdefault(about["group"], []).append(f"  {name:11}{about['purpose']}\n")
    return "\n".join(f"{title}\n{''.join(lines)}" for title, lines in groups.items())
