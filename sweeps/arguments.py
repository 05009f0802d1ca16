"""The arguments of every subcommand of `steerbench`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

Parser = argparse.ArgumentParser


def _run(run: Parser) -> None:
    """Hydra reads its arguments."""


def _tables(tables: Parser) -> None:
    tables.add_argument("--table", metavar="NAME", help="only this one, as table3")
    tables.add_argument(
        "--report", type=Path, metavar="DIR", help="where the page goes (default OUTPUTS/paper)"
    )
    tables.add_argument(
        "overrides",
        nargs="*",
        help="settings as of `steerbench run`; seed=0,1,2 gives means and intervals",
    )


def _paper(paper: Parser) -> None:
    paper.description = (
        "Measure every table of the SteerNeRF paper and write them beside the paper's figures. "
        "What was measured before is taken from the store: after an interruption, type the same "
        "again. Exits with 1 if a job failed."
    )
    _tables(paper)


def _report(report: Parser) -> None:
    report.description = (
        "Write the tables of the SteerNeRF paper beside the paper's figures, as Markdown and as "
        "one HTML file, from what the store has under the same settings. With --check: name what "
        "looks broken in the whole store."
    )
    _tables(report)
    report.add_argument(
        "--check", action="store_true", help="write nothing, exit with 1 if a row looks broken"
    )


def _list(listing: Parser) -> None:
    listing.set_defaults(module="catalogue")


def _results(results: Parser) -> None:
    _outputs(results)
    results.add_argument("--format", choices=["table", "csv", "json"], default="table")
    for column in ("method", "scene", "metric"):
        results.add_argument(f"--{column}", help=f"only rows of this {column}")


def _kernels(kernels: Parser) -> None:
    kernels.add_argument("--filter", default="", help="only kernels whose name contains this")
    _count(kernels, "--repeats", 5, "timed calls of each")


VARIANTS = (
    "Train SteerNeRF, or take what the same training left behind; then render the same frames, in "
    "turn, again and again, "
)


def _rounds(parser: Parser, frames: int, repeats: int = 3) -> None:
    _count(parser, "--frames", frames, "first frames of the trajectory")
    _count(parser, "--repeats", repeats, "timed rounds over all of them; the median counts")


def _parity(parity: Parser) -> None:
    parity.description = VARIANTS + (
        "with every engine and precision that can be used here, and compare them with torch in "
        "fp32."
    )
    _rounds(parity, 40)
    _overrides(parity)


def _skips(skips: Parser) -> None:
    skips.description = VARIANTS + (
        "with everything computed that could be left out, with each of it left out alone, and with "
        "all of it; without refinement."
    )
    _rounds(skips, 10)
    _overrides(skips)


def _breakdown(breakdown: Parser) -> None:
    breakdown.description = VARIANTS + (
        "at every precision of an engine, with and without skipping, and where the camera of the "
        "next frame is known, and tell the time of a frame by its parts; beside Instant-NGP, which "
        "renders the field of stage 1 at full resolution, and the paper's pipeline, whose U-Net is "
        "trained for its time alone. Where nothing is skipped, refinement takes its share of all "
        "cells: method.pipeline.refined=0 leaves it out."
    )
    _rounds(breakdown, 10)
    _overrides(breakdown, " (default engine=openvino)")


def _scaling(scaling: Parser) -> None:
    scaling.description = (
        "Render the first steady frames of a trajectory at several sizes, with several numbers of "
        "threads, preceding frames (L) and features (K), and lengths of the hash table (T), and "
        "fit a power of each to time and memory. A field is trained for each T; 2D renderers "
        "hardly, for what they have learned does not change what they cost."
    )
    _count(scaling, "--frames", 20, "steady frames of each")
    scaling.add_argument(
        "--axis",
        action="append",
        choices=["pixels", "threads", "L", "K", "T"],
        help="only this one; may be given more than once",
    )
    scaling.add_argument("--plot", type=Path, metavar="FILE.png", help="draw it, too")
    _overrides(scaling)


def _accuracy(accuracy: Parser) -> None:
    accuracy.description = (
        "Turn every knob that trades time for error and measure both: of the kernels where the "
        "exact answer is known, of SteerNeRF on the frames of one trained model, all settings in "
        "turn. Prints what no other setting beats (the Pareto frontier); table, plot and rows go "
        "to OUTPUTS/accuracy."
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
        "--filter",
        action="append",
        help="only knobs whose name contains this: step, range, engine, refined, trained, ...; may "
        "be given more than once",
    )
    _rounds(accuracy, 24, 5)
    _overrides(accuracy, " (default scene=totem budget=demo trajectory=orbit)")


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
        "Compare the runs of the store with those of a baseline that were made by the same "
        "command, metric by metric with its own limit, frame by frame where both have them. Exits "
        "with 1 if anything is worse or missing."
    )
    check.add_argument("baseline", type=Path, metavar="BASELINE.json")
    check.add_argument("--record", action="store_true", help="write the baseline from the store")
    _outputs(check)


def _compare(compare: Parser) -> None:
    compare.description = "Compare two runs of the store, as `steerbench check` does."
    compare.add_argument("old", metavar="RUN_A", help="its key, or how that begins")
    compare.add_argument("new", metavar="RUN_B")
    _outputs(compare)
    compare.set_defaults(module="check", function="compare")


def _scenes(scenes: Parser) -> None:
    actions = scenes.add_subparsers(title="actions", metavar="ACTION", required=True)
    verify = actions.add_parser("verify", help="compare with the official checksums")
    verify.add_argument("path", type=Path, help="folder of one scene or of all of NeRF-Synthetic")
    verify.set_defaults(module="verify", parser=verify)


def _generic(generic: Parser) -> None:
    generic.description = (
        "Fit a field to each of many random scenes, train one 2D renderer on all of them, write "
        "its weights: what renderer.init=generic starts from."
    )
    _count(generic, "--scenes", 8, "random scenes")
    generic.add_argument(
        "--output", type=Path, required=True, metavar="FILE", help="the weights, safetensors"
    )
    _overrides(generic)


def _overrides(parser: Parser, usual: str = "") -> None:
    parser.add_argument("overrides", nargs="*", help=f"settings as of `steerbench run`{usual}")


def _count(parser: Parser, name: str, usual: int, of_what: str) -> None:
    help_ = f"{of_what} (default {usual})"
    parser.add_argument(name, type=number, default=usual, metavar="N", help=help_)


def number(text: str) -> int:
    """A number of things; argparse calls it by the name of this function where it is none."""
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {count}")
    return count


def _outputs(parser: Parser) -> None:
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), metavar="DIR")


COMMANDS: dict[str, tuple[str, Callable[[Parser], None]]] = {
    "run": ("train, render, measure; print and store the table", _run),
    "paper": ("every table of the SteerNeRF paper, measured, as one page", _paper),
    "report": ("the same page of what was measured so far", _report),
    "list": ("methods, scenes, backends, engines", _list),
    "results": ("print all that was measured", _results),
    "kernels": ("throughput and error of every kernel", _kernels),
    "parity": ("every engine and precision of the 2D renderer on the same frames", _parity),
    "skips": ("what is not computed, what that saves and what it costs", _skips),
    "breakdown": (
        "where the time of a frame goes, by precision, with and without skips",
        _breakdown,
    ),
    "scaling": ("how a frame's time and memory grow with its size, L, K, T and threads", _scaling),
    "accuracy": ("run time against error of every knob, and which setting to take", _accuracy),
    "stress": ("what must hold where numbers are extreme", _stress),
    "check": ("compare what was measured with a recorded baseline", _check),
    "compare": ("what one run is against another", _compare),
    "scenes": ("look after copies of data sets", _scenes),
    "generic": ("train the 2D renderer that scenes start from", _generic),
}
"""What each is for, and what gives its parser its arguments; a module of its name runs it, unless
that says another."""


def add_commands(parser: Parser) -> None:
    """Give `parser` all commands. What it reads has the `module` of `sweeps` to run, None for no
    command, the `function` in it, and the innermost `parser`."""
    parser.set_defaults(module=None, function="main", parser=parser)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for name, (purpose, give_arguments) in COMMANDS.items():
        command = commands.add_parser(name, help=purpose)
        command.set_defaults(module=name, parser=command)
        give_arguments(command)
