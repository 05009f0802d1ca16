"""The command `steerbench`: dispatches to subcommands and maps errors and signals to exit statuses.

Exit statuses: 0 done; 1 a check failed (a kernel is wrong, a file differs), a job of the tables
failed, or a bug (with its traceback); 2 an error the user can act on; 130 interrupted; 141 the
reader of a pipe closed it; 143 terminated.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from bench.errors import SteerbenchError
from sweeps.arguments import COMMANDS, add_commands, overview
from sweeps.names import unknown
from sweeps.processes import set_up

EXAMPLES = """\
examples
  steerbench run +experiment=demo              three methods on an embedded scene, and a page
  steerbench run scene=blender scene.path=DIR  Instant-NGP on your copy of a NeRF-Synthetic scene
  steerbench run --help                        all choices and settings
  steerbench paper budget=demo                 every table of the SteerNeRF paper, as a page
  steerbench parity scene=totem budget=demo    what int8 costs, in decibels, and saves, in time
  steerbench accuracy --within 0.1dB           the fastest setting that loses no more than that
  steerbench check BASELINE.json               is everything as good as it was
  steerbench results --format csv              every number measured so far

`steerbench COMMAND --help` explains a command.
"""

# Errors of the file system that deserve a plain sentence rather than a traceback.
REFUSALS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR}


class Parser(argparse.ArgumentParser):
    """An argument parser that raises its errors as SteerbenchError instead of exiting."""

    def error(self, message: str) -> NoReturn:
        raise SteerbenchError(f"{message}\n{self.format_usage().rstrip()}")


def main() -> None:
    """Run the command line and exit with its status."""
    set_up()
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(guard(dispatch, sys.argv[1:]))


def guard(command: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
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
        return _fail(f"{error.filename}: {error.strerror}", 2)


def dispatch(argv: Sequence[str]) -> int:
    """Pass `argv` to the file of its command, which is imported only now.

    Raises:
        SteerbenchError: there is no such command or argument, or the command failed.
    """
    of_hydra = argv[:1] == ["run"] or argv[:1] in (["-sc"], ["--shell-completion"])
    options = None if of_hydra else parsed(argv)
    if options and options.command is None:
        options.parser.print_help()
        return 0
    name = options.command if options else "run"
    file = COMMANDS[name].get("module", name)
    command = importlib.import_module(f"sweeps.commands.{file}")
    return command.main(options or argv[argv[0] == "run" :])


def parsed(argv: Sequence[str]) -> argparse.Namespace:
    """The arguments of a command other than `run`."""
    parser = Parser(
        prog="steerbench",
        usage="steerbench COMMAND [...]",
        description=f"Benchmarks of radiance-field renderers.\n\n{overview()}",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_commands(parser)
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


def _terminate(signum: int, frame: object) -> NoReturn:
    """Exit through every `finally`, so that checkpoints are saved and temporary files removed."""
    sys.exit(128 + signum)


def _fail(message: str, status: int) -> int:
    print(f"steerbench: {message}", file=sys.stderr)
    return status
