"""The arguments of every subcommand of `steerbench`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

Parser = argparse.ArgumentParser


def _run(run: Parser) -> None:
    """Hydra reads its arguments."""


def _tables(tables: Parser) -> None:
    tables.add_argument("--table", metavar="NAME", help="only this table, for example table3")
    tables.add_argument(
        "--with",
        dest="methods",
        action="append",
        default=[],
        metavar="METHOD",
        help="add a line to Table 1 for this method, under the same settings as the others and "
        "without published figures; may be repeated. With --config-dir also for a method of your "
        "own: steerbench paper --table table1 --config-dir DIR --with mine",
    )
    tables.add_argument(
        "--report", type=Path, metavar="DIR", help="where the page goes (default OUTPUTS/paper)"
    )
    _overrides(tables, "; seed=0,1,2 gives means and intervals")


def _paper(paper: Parser) -> None:
    paper.description = (
        "Measure every table of the SteerNeRF paper and write them beside the paper's figures. "
        "What was measured before is read from the store: after an interruption, type the same "
        "command again. Exits with 1 if a job failed."
    )
    _tables(paper)


def _report(report: Parser) -> None:
    report.description = (
        "Write the tables of the SteerNeRF paper beside the paper's figures, as Markdown and as "
        "one HTML file, from what the store has under the same settings; nothing is measured. With "
        "--check: print the rows of the store that look broken."
    )
    _tables(report)
    report.add_argument(
        "--check", action="store_true", help="write nothing, exit with 1 if a row looks broken"
    )


def _list(listing: Parser) -> None:
    listing.description = (
        "List the choices of `steerbench run`, and which backends and engines this machine has."
    )
    _config_dir(listing)
    listing.set_defaults(module="catalogue")


def _results(results: Parser) -> None:
    results.description = "Print the rows of all runs in the store."
    _outputs(results)
    results.add_argument("--format", choices=["table", "csv", "json"], default="table")
    for column in ("method", "scene", "metric"):
        results.add_argument(f"--{column}", help=f"only rows of this {column}")


def _kernels(kernels: Parser) -> None:
    kernels.description = (
        "Compare every kernel with its reference and measure its speed. Exits with 1 if a result "
        "is wrong."
    )
    kernels.add_argument("--filter", default="", help="only kernels whose name contains this")
    _count(kernels, "--repeats", 5, "timed calls of each")


VARIANTS = (
    "Train a method, or read the same training from the store. Then render the same frames again "
    "and again, in turn, "
)


def _rounds(parser: Parser, frames: int, repeats: int = 3) -> None:
    _count(parser, "--frames", frames, "first frames of the trajectory")
    _count(parser, "--repeats", repeats, "timed rounds over these frames; the median counts")


def _parity(parity: Parser) -> None:
    parity.description = VARIANTS + (
        "with every engine and precision that this machine has, and compare them with torch in "
        "fp32. The method must have a network that an engine computes."
    )
    _rounds(parity, 40)
    _overrides(parity, " (default method=steernerf_lean trajectory=smooth)")


def _skips(skips: Parser) -> None:
    skips.description = VARIANTS + (
        "with nothing skipped, with each skip of the method alone, and with all of them."
    )
    _rounds(skips, 10)
    _overrides(skips, " (default method=steernerf_lean trajectory=smooth)")


def _breakdown(breakdown: Parser) -> None:
    breakdown.description = VARIANTS + (
        "at every precision of an engine, with and without the skips of the method, and beside the "
        "methods that it names for comparison; print the time of a frame by its parts."
    )
    _rounds(breakdown, 10)
    _overrides(breakdown, " (default method=steernerf_lean trajectory=smooth engine=openvino)")


def _scaling(scaling: Parser) -> None:
    scaling.description = (
        "Render the first steady frames of a trajectory at several sizes, with several numbers of "
        "threads, and along the axes that the method declares (of SteerNeRF: L, K and T), and fit "
        "a power of each to time, work and memory. 2D renderers are hardly trained: what they have "
        "learned does not change what they cost."
    )
    _count(scaling, "--frames", 20, "steady frames of each")
    scaling.add_argument(
        "--axis",
        action="append",
        metavar="NAME",
        help="only this axis: pixels, threads, or one of the method's; may be repeated",
    )
    scaling.add_argument("--plot", type=Path, metavar="FILE.png", help="also draw the figures")
    _overrides(scaling, " (default method=steernerf_lean trajectory=smooth)")


def _accuracy(accuracy: Parser) -> None:
    accuracy.description = (
        "Vary every knob that trades time for error and measure both: for the kernels where the "
        "exact answer is known, for a method on the frames of one trained model. Prints which "
        "settings no other beats (the Pareto frontier); table, plot and rows go to "
        "OUTPUTS/accuracy."
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
        help="also knobs each of whose settings needs a training of its own",
    )
    accuracy.add_argument(
        "--filter",
        action="append",
        help="only knobs whose name contains this, for example range or engine; may be repeated",
    )
    _rounds(accuracy, 24, 5)
    _overrides(
        accuracy, " (default method=steernerf_lean scene=totem budget=demo trajectory=orbit)"
    )


def _stress(stress: Parser) -> None:
    stress.description = (
        "Run every numerical stress case with every backend, engine and precision that it is for; "
        "print what must hold, the worst error seen and the largest that is right. Exits with 1 if "
        "anything fails."
    )
    stress.add_argument("--filter", default="", help="only subjects and cases with this in it")
    stress.add_argument(
        "--format",
        choices=["table", "markdown"],
        default="table",
        help="markdown: for a page, a line a case",
    )


def _check(check: Parser) -> None:
    check.description = (
        "Compare the runs of the store with those of a baseline that the same commands made, "
        "metric by metric with its own limit, frame by frame where both have them. Exits with 1 if "
        "anything is worse or missing."
    )
    check.add_argument("baseline", type=Path, metavar="BASELINE.json")
    check.add_argument("--record", action="store_true", help="write the baseline from the store")
    _outputs(check)


def _compare(compare: Parser) -> None:
    compare.description = "Compare two runs of the store, as `steerbench check` does."
    compare.add_argument("old", metavar="RUN_A", help="the key of a run, or its beginning")
    compare.add_argument("new", metavar="RUN_B")
    _outputs(compare)
    compare.set_defaults(module="check", function="compare")


def _scenes(scenes: Parser) -> None:
    actions = scenes.add_subparsers(title="actions", metavar="ACTION", required=True)
    verify = actions.add_parser("verify", help="compare with the official checksums")
    verify.add_argument("path", type=Path, help="folder of one scene or of all of NeRF-Synthetic")
    verify.set_defaults(module="verify", parser=verify)


def _pretrain(pretrain: Parser) -> None:
    pretrain.description = (
        "Fit a field to each of many random scenes, train one 2D renderer on all of them, write "
        "its weights: renderer.init=pretrained starts from them."
    )
    _count(pretrain, "--scenes", 8, "random scenes")
    pretrain.add_argument(
        "--output", type=Path, required=True, metavar="FILE", help="the weights, safetensors"
    )
    _overrides(pretrain)


def _overrides(parser: Parser, usual: str = "") -> None:
    parser.add_argument("overrides", nargs="*", help=f"settings as of `steerbench run`{usual}")
    _config_dir(parser)


def _config_dir(parser: Parser) -> None:
    parser.add_argument(
        "--config-dir",
        action="append",
        type=config_dir,
        default=[],
        metavar="DIR",
        help="folder with further choices, as DIR/method/mine.yaml for method=mine",
    )


def config_dir(text: str) -> str:
    """The word for the folder `text`, which must exist; see `sweeps.overrides`."""
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(f"expected a folder, there is none at {text}")
    return f"--config-dir={Path(text).resolve()}"


def positive_int(text: str) -> int:
    """A whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {text}")
    return int(text)


def _count(parser: Parser, name: str, usual: int, of_what: str) -> None:
    help_ = f"{of_what} (default {usual})"
    parser.add_argument(name, type=positive_int, default=usual, metavar="N", help=help_)


def _outputs(parser: Parser) -> None:
    parser.add_argument(
        "--outputs", type=Path, default=Path("outputs"), metavar="DIR", help="(default outputs)"
    )


STUDIES = "studies of a method"

Command = tuple[str, Callable[[Parser], None]]

GROUPS: dict[str, dict[str, Command]] = {
    "measure": {
        "run": ("train, render and measure; print and store the table", _run),
        "paper": ("measure every table of the SteerNeRF paper, as one page", _paper),
        "pretrain": ("train the weights that the lean 2D renderer starts from", _pretrain),
    },
    "look": {
        "list": ("methods, scenes, budgets, engines: what can be chosen", _list),
        "results": ("everything measured so far, as a table, csv or json", _results),
        "report": ("the page of `steerbench paper`, from what was measured so far", _report),
        "compare": ("the differences between two runs", _compare),
    },
    STUDIES: {
        "accuracy": ("run time against error of every knob, and which setting to take", _accuracy),
        "parity": ("error and time of every engine and precision", _parity),
        "skips": ("what is not computed, what that saves and what it costs", _skips),
        "breakdown": ("the time of a frame by its parts, at every precision", _breakdown),
        "scaling": (
            "how time and memory grow with the size of a frame, threads, L, K, T",
            _scaling,
        ),
    },
    "checks": {
        "check": ("compare the store with a recorded baseline", _check),
        "kernels": ("error and speed of every kernel", _kernels),
        "stress": ("what must hold where numbers are extreme", _stress),
        "scenes": ("compare a copy of NeRF-Synthetic with the official checksums", _scenes),
    },
}
"""By group, the purpose of each command and the function that adds its arguments. The module of
its name runs it, unless these say another."""

COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


def add_commands(parser: Parser) -> None:
    """Add all commands to `parser`. What it reads has the `module` of `sweeps` to run, None for no
    command, the `function` in it, and the innermost `parser`."""
    parser.set_defaults(module=None, function="main", parser=parser)
    commands = parser.add_subparsers(prog=parser.prog, metavar="COMMAND", help=argparse.SUPPRESS)
    for title, group in GROUPS.items():
        folder = "studies." if title == STUDIES else ""
        for name, (purpose, add_arguments) in group.items():
            command = commands.add_parser(name, description=f"{purpose[0].upper()}{purpose[1:]}.")
            command.set_defaults(module=f"{folder}{name}", parser=command)
            add_arguments(command)


def overview() -> str:
    """All commands in their groups, a line each."""
    lines = []
    for title, commands in GROUPS.items():
        lines += ["", title, *(f"  {name:11}{purpose}" for name, (purpose, _) in commands.items())]
    return "\n".join(lines[1:])
