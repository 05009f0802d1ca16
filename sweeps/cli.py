"""The command `steerbench`: what can be asked for, and how errors and signals end it.

Exit statuses: 0 done, 1 a check failed (a kernel is wrong, a file differs) or a bug (with its
traceback), 2 an error the user can act on, 130 interrupted, 141 the reader of a pipe went away,
143 terminated.
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
from pathlib import Path
from typing import Any, NoReturn

from bench.errors import SteerbenchError
from sweeps.names import unknown

# Two thread pools take turns here, torch's and numba's. A pool that spins while it waits keeps the
# other from its cores, one that sleeps at once is woken a thousand times a step: let it spin for
# some ten microseconds.
os.environ.setdefault("GOMP_SPINCOUNT", "20000")

EXAMPLES = """\
examples
  steerbench run +experiment=demo              three methods on an embedded scene, and a page
  steerbench run scene=blender scene.path=DIR  the same on your copy of a NeRF-Synthetic scene
  steerbench run --help                        all choices and settings
  steerbench list                              what there is, and what of it is usable here
  steerbench paper budget=tables               every table of the SteerNeRF paper, as a page
  steerbench parity scene=totem budget=demo    what int8 costs, in decibels, and saves, in time
  steerbench accuracy --within 0.1dB           the fastest setting that loses no more than that
  steerbench check BASELINE.json               is everything as good as it was
  steerbench results --format csv              every number measured so far
"""

COMMANDS = (
    "run",
    "paper",
    "report",
    "list",
    "results",
    "kernels",
    "parity",
    "skips",
    "scaling",
    "stress",
    "accuracy",
    "check",
    "compare",
    "scenes",
    "generic",
)

# What the disk refuses: worth a plain sentence, not a traceback.
REFUSALS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR}


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors end the program as all others do."""

    def error(self, message: str) -> NoReturn:
        raise SteerbenchError(f"{message}\n{self.format_usage().rstrip()}")


def main() -> None:
    """Run the command line and exit with its status."""
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(guard(dispatch, sys.argv[1:]))


def guard(command: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Run `command` and turn what ends it into an exit status and at most one message."""
    try:
        status = command(argv)
        sys.stdout.flush()
        return status
    except SteerbenchError as error:
        return _fail(str(error), 2)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:
        # Python flushes standard output once more at exit; let it do so into nothing.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if error.errno not in REFUSALS:
            raise
        return _fail(f"{error.filename}: {error.strerror}", 2)


def dispatch(argv: Sequence[str]) -> int:
    """Hand `argv` to its subcommand, which is imported only then."""
    if argv[:1] == ["run"] or argv[:1] in (["-sc"], ["--shell-completion"]):
        from sweeps import run

        return run.main(argv[1:] if argv[0] == "run" else argv)
    parser = _parser()
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:
        raise unknown("command", argv[0], COMMANDS)
    options, unread = parser.parse_known_args(argv)
    if unread:
        known = re.findall(r"--[\w-]+", options.parser.format_help())
        raise unknown("argument", unread[0], set(known))
    if options.module is None:
        parser.print_help()
        return 0
    module = importlib.import_module(f"sweeps.{options.module}")
    return getattr(module, options.function)(options)


def _parser() -> Parser:
    parser = Parser(
        prog="steerbench",
        description="Radiance-field renderers measured under one ruler.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(module=None, function="main", parser=parser)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    commands.add_parser("run", help="train, render, measure; print and store the table")

    for name, short, long in (
        (
            "paper",
            "every table of the SteerNeRF paper, measured, as one page",
            "Measure every table of the SteerNeRF paper and write them beside the paper's figures. "
            "What was measured before is taken from the store: after an interruption, type the "
            "same again. Exits with 1 if a job failed.",
        ),
        (
            "report",
            "the same page of what was measured so far",
            "Write the tables of the SteerNeRF paper beside the paper's figures, as Markdown and "
            "as one HTML file, from what the store has under the same settings. With --check: "
            "name what looks broken in the whole store.",
        ),
    ):
        tables = commands.add_parser(name, help=short, description=long)
        tables.add_argument("--table", metavar="NAME", help="only this one: table1 to table6")
        tables.add_argument(
            "--report", type=Path, metavar="DIR", help="where the page goes (default OUTPUTS/paper)"
        )
        tables.add_argument(
            "overrides",
            nargs="*",
            help="settings as of `steerbench run`; seed=0,1,2 gives means and intervals",
        )
        if name == "report":
            tables.add_argument(
                "--check",
                action="store_true",
                help="write nothing, exit with 1 if a row looks broken",
            )
        tables.set_defaults(module=name, parser=tables)

    listing = commands.add_parser("list", help="methods, scenes, backends, engines")
    listing.set_defaults(module="catalogue", parser=listing)

    results = commands.add_parser("results", help="print all that was measured")
    results.add_argument("--outputs", type=Path, default=Path("outputs"), metavar="DIR")
    results.add_argument("--format", choices=["table", "csv", "json"], default="table")
    for column in ("method", "scene", "metric"):
        results.add_argument(f"--{column}", help=f"only rows of this {column}")
    results.set_defaults(module="results", parser=results)

    kernels = commands.add_parser("kernels", help="throughput and error of every kernel")
    kernels.add_argument("--filter", default="", help="only kernels whose name contains this")
    kernels.add_argument("--repeats", type=int, default=5, help="timed calls of each (default 5)")
    kernels.set_defaults(module="kernels", parser=kernels)

    for name, short, long, frames in (
        (
            "parity",
            "every engine and precision of the 2D renderer on the same frames",
            "with every engine and precision that can be used here, and compare them with torch in "
            "fp32.",
            60,
        ),
        (
            "skips",
            "what is not computed, what that saves and what it costs",
            "with everything computed that could be left out, with each of it left out alone, and "
            "with all of it; without refinement.",
            8,
        ),
    ):
        variants = commands.add_parser(
            name,
            help=short,
            description="Train SteerNeRF, or take what the same training left behind; then render "
            f"the same frames {long}",
        )
        variants.add_argument(
            "--frames",
            type=int,
            default=frames,
            help=f"first frames of the trajectory (default {frames})",
        )
        variants.add_argument("overrides", nargs="*", help="settings as of `steerbench run`")
        variants.set_defaults(module=name, parser=variants)

    scaling = commands.add_parser(
        "scaling",
        help="how a frame's time and memory grow with its size, L, K, T and threads",
        description="Render the first steady frames of a trajectory at several sizes, with several "
        "numbers of threads, preceding frames (L) and features (K), and lengths of the hash table "
        "(T), and fit a power of each to time and memory. A field is trained for each T; 2D "
        "renderers hardly, for what they have learned does not change what they cost.",
    )
    scaling.add_argument("--frames", type=int, default=20, help="steady frames each (default 20)")
    scaling.add_argument("--plot", type=Path, metavar="FILE.png", help="draw it, too")
    scaling.add_argument("overrides", nargs="*", help="settings as of `steerbench run`")
    scaling.set_defaults(module="scaling", parser=scaling)

    stress = commands.add_parser(
        "stress",
        help="what must hold where numbers are extreme",
        description="Run every numerical stress case with every backend, engine and precision that "
        "it is for; print what must hold, the worst error seen and the largest that is right. "
        "Exits with 1 if anything fails.",
    )
    stress.add_argument("--filter", default="", help="only subjects and cases with this in it")
    stress.add_argument(
        "--format",
        choices=["table", "markdown"],
        default="table",
        help="markdown: for a page, a line a case",
    )
    stress.set_defaults(module="stress", parser=stress)

    _add_accuracy(commands)

    check = commands.add_parser(
        "check",
        help="compare what was measured with a recorded baseline",
        description="Compare the runs of the store with those of a baseline that were made by the "
        "same command, metric by metric with its own limit, frame by frame where both have them. "
        "Exits with 1 if anything is worse or missing.",
    )
    check.add_argument("baseline", type=Path, metavar="BASELINE.json")
    check.add_argument("--record", action="store_true", help="write the baseline from the store")
    check.add_argument("--outputs", type=Path, default=Path("outputs"), metavar="DIR")
    check.set_defaults(module="check", parser=check)

    compare = commands.add_parser(
        "compare",
        help="what one run is against another",
        description="Compare two runs of the store, as `steerbench check` does.",
    )
    compare.add_argument("old", metavar="RUN_A", help="its key, or how that begins")
    compare.add_argument("new", metavar="RUN_B")
    compare.add_argument("--outputs", type=Path, default=Path("outputs"), metavar="DIR")
    compare.set_defaults(module="check", function="compare", parser=compare)

    scenes = commands.add_parser("scenes", help="look after copies of data sets")
    actions = scenes.add_subparsers(title="actions", metavar="ACTION", required=True)
    verify = actions.add_parser("verify", help="compare with the official checksums")
    verify.add_argument("path", type=Path, help="folder of one scene or of all of NeRF-Synthetic")
    verify.set_defaults(module="verify", parser=verify)

    generic = commands.add_parser(
        "generic",
        help="train the 2D renderer that scenes start from",
        description="Fit a field to each of many random scenes, train one 2D renderer on all of "
        "them, write its weights: what renderer.init=generic starts from.",
    )
    generic.add_argument("--scenes", type=int, default=8, help="random scenes (default 8)")
    generic.add_argument(
        "--output", type=Path, required=True, metavar="FILE", help="the weights, safetensors"
    )
    generic.add_argument("overrides", nargs="*", help="settings as of `steerbench run`")
    generic.set_defaults(module="generic", parser=generic)
    return parser


def _add_accuracy(commands: Any) -> None:
    accuracy = commands.add_parser(
        "accuracy",
        help="run time against error of every knob, and which setting to take",
        description="Turn every knob that trades time for error and measure both: of the kernels "
        "where the exact answer is known, of SteerNeRF on the frames of one trained model, all "
        "settings in turn. Prints what no other setting beats (the Pareto frontier); table, plot "
        "and rows go to OUTPUTS/accuracy.",
    )
    accuracy.add_argument(
        "--within",
        metavar="DECIBELS",
        help="also print the fastest setting that loses at most so much PSNR against everything "
        "off, as a command: --within 0.1dB",
    )
    accuracy.add_argument(
        "--kernels", action="store_true", help="only the kernels: seconds, and nothing is trained"
    )
    accuracy.add_argument(
        "--trained",
        action="store_true",
        help="also what asks for trainings of its own: L, K, s, T, taught steps, a field in fp32",
    )
    accuracy.add_argument(
        "--frames", type=int, default=24, help="first frames of the trajectory (default 24)"
    )
    accuracy.add_argument(
        "--repeats", type=int, default=5, help="timed rounds over all settings (default 5)"
    )
    accuracy.add_argument(
        "overrides",
        nargs="*",
        help="settings as of `steerbench run` (default scene=totem budget=demo trajectory=orbit)",
    )
    accuracy.set_defaults(module="accuracy", parser=accuracy)


def _terminate(signum: int, frame: object) -> NoReturn:
    """Leave through every `finally`, so that checkpoints are kept and temporary files are not."""
    sys.exit(128 + signum)


def _fail(message: str, status: int) -> int:
    print(f"steerbench: {message}", file=sys.stderr)
    return status
