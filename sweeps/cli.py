"""The command `steerbench`: reads the words, calls the command, maps its end to an exit status.

commands.toml lists and explains the commands and their arguments.

Exit statuses: 0 done; 1 a check failed (a kernel is wrong, a file differs), a job of the tables
failed, or a bug (with its traceback); 2 an error the user can act on; 130 interrupted; 141 the
reader of a pipe closed it; 143 terminated.
"""

import argparse
import errno
import importlib
import math
import os
import re
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from bench.errors import SteerbenchError, unknown
from bench.kinds import Words
from bench.records import without
from sweeps.processes import set_up

COMMANDS: dict[str, dict[str, Any]] = tomllib.loads(
    (Path(__file__).parent / "commands.toml").read_text(encoding="utf-8")
)
"""What commands.toml says of each command, by name."""
_SHARED = COMMANDS.pop("shared")

EXAMPLES = """\
examples
  steerbench run +experiment=demo              three methods on an embedded scene, and a page
  steerbench run scene=blender scene.path=DIR  Instant-NGP on your copy of a NeRF-Synthetic scene
  steerbench run --help                        all choices and settings
  steerbench paper budget=demo                 every table of the SteerNeRF paper, as a page
  steerbench table table3 --format latex       one table, or one of your own; also for an article
  steerbench parity scene=totem budget=demo    what int8 costs, in decibels, and saves, in time
  steerbench accuracy --within 0.1dB           the fastest setting that loses no more than that
  steerbench check BASELINE.json               is everything as good as it was
  steerbench results --format csv              every number measured so far

`steerbench COMMAND --help` explains a command.
"""

PLACES = ("outputs", "report")

# Errors of the file system that deserve a plain sentence rather than a traceback.
REFUSALS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR}


def main() -> None:
    """Run the command line and exit with its status."""
    set_up()
    # Exit through every `finally`, so that checkpoints are saved and temporary files removed.
    signal.signal(signal.SIGTERM, lambda signum, _: sys.exit(128 + signum))
    sys.exit(guard(dispatch, sys.argv[1:]))


def guard(command: Callable[[Words], int], argv: Words) -> int:
    """Run `command` and turn how it ends into an exit status and at most one message."""
    try:
        status = command(argv)
        sys.stdout.flush()
        return status
    except SteerbenchError as error:
        return _fail(str(error), 2)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:
        # Python flushes standard output again at exit; redirect that to /dev/null.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if error.errno not in REFUSALS:
            raise
        return _fail(": ".join(map(str, filter(None, (error.filename, error.strerror)))), 2)


def _fail(message: str, status: int) -> int:
    print(f"steerbench: {message}", file=sys.stderr)
    return status


def dispatch(argv: Words) -> int:
    """Pass `argv` to the file of its command, which is imported only now."""
    of_hydra = argv[:1] == ["run"] or argv[:1] in (["-sc"], ["--shell-completion"])
    argv = list(_one_form(argv))
    options = None if of_hydra else parsed(argv)
    if options and options.command is None:
        options.parser.print_help()
        return 0
    name = options.command if options else "run"
    file = COMMANDS[name].get("module", name)
    command = importlib.import_module(f"sweeps.commands.{file}")
    return command.main(options or argv[argv[0] == "run" :])


def _one_form(argv: Words) -> Iterator[str]:
    """`argv` with the folders of store and page as its command takes them.

    They are an option or a setting; every command understands `--outputs DIR` and `outputs=DIR`.
    """
    name, words = argv[0] if argv else "", iter(argv)
    if name not in COMMANDS:
        yield from argv
        return
    known = {each for names, _ in _arguments(COMMANDS[name]) for each in names}
    for word in words:
        option, equals, value = word.partition("=")
        place = option.removeprefix("--")
        if place not in PLACES or word == place:
            yield word
        elif f"--{place}" in known:
            yield f"--{place}={value}" if equals else f"--{place}"
        else:
            yield f"{place}={value if equals else next(words, '')}"


class Parser(argparse.ArgumentParser):
    """An argument parser that raises its errors as SteerbenchError instead of exiting."""

    def error(self, message: str) -> NoReturn:
        raise SteerbenchError(f"{message}\n{self.format_usage().rstrip()}")


def parsed(argv: Words) -> argparse.Namespace:
    """The arguments of a command other than `run`.

    Among them are the name of the `command`, None if there was none, the innermost `parser`, and
    what was `typed`.
    """
    overview: dict[str, str] = {}
    for name, about in COMMANDS.items():
        lines = overview.get(about["group"], f"{about['group']}\n")
        overview[about["group"]] = f"{lines}  {name:12}{about['purpose']}\n"
    parser = Parser(
        prog="steerbench",
        usage="steerbench COMMAND [...]",
        description="Benchmarks of radiance-field renderers.\n\n" + "\n".join(overview.values()),
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=version("steerbench"))
    parser.set_defaults(command=None, parser=parser)
    commands = parser.add_subparsers(prog=parser.prog, help=argparse.SUPPRESS)
    for name, about in COMMANDS.items():
        below = commands.add_parser(name, description=about["description"])
        below.set_defaults(command=name, parser=below, typed=list(argv))
        for names, given in _arguments(about):
            below.add_argument(*names, **given)
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:
        raise unknown("command", argv[0], COMMANDS)
    options, unread = parser.parse_known_args(argv)
    if "overrides" in options:  # argparse stops reading them at the next option
        options.overrides += [word for word in unread if not word.startswith("-")]
        options.overrides = [*options.config_dir, *options.overrides]
        unread = [word for word in unread if word.startswith("-")]
    if unread:
        known = re.findall(r"--[\w-]+", options.parser.format_help())
        raise unknown("argument", unread[0], set(known))
    return options


def _arguments(about: Mapping[str, Any]) -> Iterator[tuple[list[str], dict[str, Any]]]:
    """The names and the options, as for `add_argument`, of each argument of a command."""
    include = about.get("include", [])
    if usual := about.get("settings"):
        include = [*include, "folder"]
    for group in (about.get("arguments", {}), *(_SHARED[name] for name in include)):
        for name, options in group.items():
            kind = TYPES[options["type"]] if "type" in options else {}
            own = without(options, ("type", "also"))
            more = "; may be repeated" if kind.get("action") == "append" else ""
            more += f" (default {own['default']})" if own.get("default") else ""
            names = filter(None, (name, options.get("also")))
            yield [*names], {**kind, **own, "help": own["help"] + more}
    if usual:  # last, because it takes all words that are left
        help = f"settings as of `steerbench run` (default {usual})"
        yield ["overrides"], {"help": help, "nargs": "*"}


def count(text: str, at_most: float = math.inf) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {text}")
    if int(text) > at_most:
        raise argparse.ArgumentTypeError(f"expected at most {at_most}, got {text}")
    return int(text)


def positive(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
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
    "port": {"type": partial(count, at_most=65535)},
    "flag": {"action": "store_true"},
    "form": {"choices": ["markdown", "latex", "csv", "json"]},
    "several": SEVERAL,
    "folders": {**SEVERAL, "type": config_dir},
}
"""The options of argparse for each `type` of an argument."""
