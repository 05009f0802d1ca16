"""The arguments of the subcommands of `steerbench`; commands.toml lists and explains these."""

from __future__ import annotations

import argparse
import math
import tomllib
from pathlib import Path
from typing import Any

FORMATS = ("latex", "csv")
"""Formats in which the paper's tables can be exported; see `reports.export`."""

Arguments = list[tuple[tuple[str, ...], dict[str, Any]]]
"""Names and options of each argument, as for `ArgumentParser.add_argument`."""

COMMANDS: dict[str, dict[str, str]] = tomllib.loads(
    (Path(__file__).parent / "commands.toml").read_text(encoding="utf-8")
)


def positive_int(text: str) -> int:
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
    number = positive_int(text)
    if number > 65535:
        raise argparse.ArgumentTypeError(f"expected at most 65535, got {text}")
    return number


def config_dir(text: str) -> str:
    """`--config-dir=` and the folder `text`, which must exist; see `sweeps.overrides`."""
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(f"expected a folder, there is none at {text}")
    return f"--config-dir={Path(text).resolve()}"


def _one(*names: str, help: str, **options: Any) -> Arguments:
    return [(names, {"help": help, **options})]


def _flag(name: str, help: str) -> Arguments:
    return _one(name, help=help, action="store_true")


def _several(name: str, help: str, **options: Any) -> Arguments:
    return _one(name, help=f"{help}; may be repeated", action="append", **options)


def _count(name: str, usual: int, help: str) -> Arguments:
    help = f"{help} (default {usual})"
    return _one(name, help=help, type=positive_int, default=usual, metavar="N")


def _rounds(frames: int, repeats: int = 3) -> Arguments:
    return [
        *_count("--frames", frames, "first frames of the trajectory"),
        *_count("--repeats", repeats, "timed rounds over these frames; the median counts"),
    ]


def _words(usual: str) -> Arguments:
    help = f"settings as of `steerbench run` (default {usual})"
    return [*_one("overrides", help=help, nargs="*"), *FOLDER]


FOLDER = _several(
    "--config-dir",
    "folder with further choices, such as DIR/method/mine.yaml for method=mine",
    **{"type": config_dir, "default": [], "metavar": "DIR"},
)
OUTPUTS = _one(
    "--outputs",
    help="folder of the store (default outputs)",
    type=Path,
    default="outputs",
    metavar="DIR",
)
TABLES = [
    *_one("--table", help="only this table, for example table3", metavar="NAME"),
    *_several(
        "--with",
        "add a line to Table 1 for this method, under the same settings as the others and without "
        "published figures, also for a method of your own: --config-dir DIR --with mine",
        **{"dest": "methods", "default": [], "metavar": "METHOD"},
    ),
    *_one("--report", help="where the page goes (default OUTPUTS/paper)", type=Path, metavar="DIR"),
    *_one("--format", help="also print the tables, for a paper or a program", choices=[*FORMATS]),
    *_words(
        "those of each table, as many seeds as the budget says; data=DIR: every scene of a data set"
    ),
]
SMOOTH = "method=steernerf_lean trajectory=smooth"

ARGUMENTS = {
    "paper": TABLES,
    "score": [
        *_one("pictures", help="the folder of the pictures", type=Path, metavar="PICTURES"),
        *_one("--truth", help="the folder of the true ones", type=Path, metavar="DIR"),
        *_one("--name", help="of the method in the rows (default that of the folder)"),
        *_one(
            "--match",
            help="how a picture finds its truth (default name)",
            choices=["name", "order"],
            default="name",
        ),
        *_flag("--sequence", "the pictures follow one another: score the flicker, too"),
        *_words("protocol=steerbench-1 scene=totem split=test"),
    ],
    "render": [
        *_one("--run", help="take the settings of this run of the store", metavar="KEY"),
        *_one(
            "--path",
            help="cameras of a file: a path of nerfstudio's viewer, or a transforms.json",
            type=Path,
            metavar="FILE.json",
        ),
        *_several(
            "--beside",
            "also draw this method, to the right of the first",
            **{"default": [], "metavar": "METHOD"},
        ),
        *_one(
            "--output",
            help="where the pictures go (default OUTPUTS/render/SCENE-METHOD-TRAJECTORY)",
            type=Path,
            metavar="DIR",
        ),
        *_one("--video", help="also write a video", type=Path, metavar="FILE.mp4"),
        *_one("--fps", help="frames a second of it (default 30)", type=positive, default=30.0),
        *_words("method=ngp scene=totem trajectory=test budget=small"),
    ],
    "view": [
        *_one("--run", help="take the settings of this run of the store", metavar="KEY"),
        *_one("--beside", help="compare with this method", metavar="METHOD"),
        *_one(
            "--host",
            help="address to serve (default 127.0.0.1: this machine alone; 0.0.0.0: everyone)",
            default="127.0.0.1",
        ),
        *_one("--port", help="(default 8080)", type=port, default=8080, metavar="N"),
        *_words("method=ngp scene=totem trajectory=test budget=small"),
    ],
    "pretrain": [
        *_count("--scenes", 8, "random scenes"),
        *_one(
            "--output", help="the weights, safetensors", type=Path, required=True, metavar="FILE"
        ),
        *_words("method=steernerf_lean scene=medley budget=pretrain"),
    ],
    "list": [
        *_flag("--here", "also the backends and engines, and why some cannot be used here"),
        *FOLDER,
    ],
    "results": [
        *OUTPUTS,
        *_one(
            "--format", help="(default table)", choices=["table", "csv", "json"], default="table"
        ),
        *_one("--method", help="only rows of this method"),
        *_one("--scene", help="only rows of this scene"),
        *_one("--metric", help="only rows of this metric"),
    ],
    "report": [
        *TABLES,
        *_flag("--check", "write nothing; name the runs that look broken, exit with 1 if any does"),
    ],
    "compare": [
        *_one("old", help="the key of a run, or its beginning", metavar="RUN_A"),
        *_one("new", help="the same of the run to compare with it", metavar="RUN_B"),
        *OUTPUTS,
    ],
    "accuracy": [
        *_one(
            "--within",
            help="also print the fastest setting that loses at most so much PSNR against "
            "everything off, as a command: --within 0.1dB",
            metavar="DECIBELS",
        ),
        *_flag("--kernels", "only the kernels: seconds, and nothing is trained"),
        *_flag("--trained", "also knobs each of whose settings needs a training of its own"),
        *_several("--filter", "only knobs with this in their name, for example range"),
        *_rounds(24, 5),
        *_words("method=steernerf_lean scene=totem budget=demo trajectory=orbit"),
    ],
    "parity": [*_rounds(40), *_words(SMOOTH)],
    "skips": [*_rounds(10), *_words(SMOOTH)],
    "breakdown": [
        *_rounds(10),
        *_flag("--device-waits", "print where the host waits for the GPU instead, line by line"),
        *_words(f"{SMOOTH} engine=openvino, on a GPU engine=torch"),
    ],
    "scaling": [
        *_count("--frames", 20, "steady frames of each"),
        *_several("--axis", "only this axis: pixels, threads, or one of the method's"),
        *_one("--plot", help="also draw the figures", type=Path, metavar="FILE.png"),
        *_words(SMOOTH),
    ],
    "check": [
        *_one("baseline", help="the file with its figures", type=Path, metavar="BASELINE.json"),
        *_flag("--record", "write the baseline from the store"),
        *OUTPUTS,
    ],
    "kernels": [
        *_one("--filter", help="only kernels whose name contains this", default=""),
        *_count("--repeats", 5, "timed calls of each"),
        *_flag("--worth", "print what each brings to a frame and to a training of methods instead"),
        *_count("--frames", 8, "with --worth: first frames of the trajectory"),
        *_words("with --worth: all methods, scene=totem scene.width=100 budget=tiny"),
    ],
    "stress": [
        *_one("--filter", help="only subjects and cases with this in it", default=""),
        *_one(
            "--format",
            help="markdown: for a page, a line a case (default table)",
            choices=["table", "markdown"],
            default="table",
        ),
    ],
    "scenes": [
        *_one("action", help="what to do", choices=["get", "verify"]),
        *_one("name", help="a scene or data set to get, or a folder of scenes to verify"),
        *_one(
            "--to",
            help="folder that they are put into (default data)",
            type=Path,
            default="data",
            metavar="DIR",
        ),
    ],
}
"""Arguments of each command but `run`, whose arguments Hydra parses."""


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
        for names, options in ARGUMENTS.get(name, ()):
            below.add_argument(*names, **options)


def overview() -> str:
    """All commands by group, one line each."""
    groups: dict[str, list[str]] = {}
    for name, about in COMMANDS.items():
        groups.setdefault(about["group"], []).append(f"  {name:11}{about['purpose']}\n")
    return "\n".join(f"{title}\n{''.join(lines)}" for title, lines in groups.items())
