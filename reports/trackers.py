"""Sends a run of the store to an experiment tracker, under the run's key.

There is one class per tracker. Each sends the figures of every frame as a series, the headline
figures as a summary, the pictures and the provenance. A run already sent under the same key is
replaced or kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from bench.errors import SteerbenchError, Unavailable, install_command
from reports.runs import Run

PROJECT = "steerbench"
"""The name of the project or experiment in a tracker."""

FACTS = ("method", "scene", "resolution", "trajectory", "budget", "protocol", "seed", "device")
"""Columns of the rows that say what was measured."""


class Tracker(Protocol):
    """An experiment tracker, to which runs are sent.

    Attributes:
        package: the package that it needs.
    """

    package: str

    def send(self, run: Run, outputs: Path) -> None:
        """Send the figures and pictures of `run`; `outputs` is the folder of its store."""


class WandB:
    """Weights & Biases: a run with the key as id. W&B's environment variables set the target."""

    package = "wandb"

    def send(self, run: Run, outputs: Path) -> None:
        import wandb

        with wandb.init(
            project=PROJECT,
            id=run.key,
            name=run.label,
            config=settings(run),
            dir=outputs,
            resume="allow",
        ) as sent:
            for frame, figures in series(run):
                sent.log(figures, step=frame)
            sent.log({name: wandb.Image(str(path)) for name, path in pictures(run)})
            sent.summary.update(headline(run))


class TensorBoard:
    """TensorBoard: event files in OUTPUTS/tensorboard/KEY, written once."""

    package = "tensorboard"

    def send(self, run: Run, outputs: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        folder = outputs / "tensorboard" / run.key
        if folder.exists():
            return
        with SummaryWriter(str(folder)) as writer:
            lines = [f"{name}: {value}" for name, value in settings(run).items()]
            writer.add_text("settings", "  \n".join(lines))
            for frame, figures in series(run):
                for name, value in figures.items():
                    writer.add_scalar(f"frame/{name}", value, frame)
            for name, value in headline(run).items():
                writer.add_scalar(f"run/{name}", value)
            for name, path in pictures(run):
                with Image.open(path) as image:
                    writer.add_image(name, np.asarray(image.convert("RGB")), dataformats="HWC")


TRACKERS: Mapping[str, Tracker] = {
    "wandb": WandB(),
    "tensorboard": TensorBoard(),
}


def tracker(name: str) -> Tracker:
    """The tracker called `name`.

    Raises:
        SteerbenchError: there is no such tracker.
        Unavailable: its package is not installed.
    """
    if name not in TRACKERS:
        raise SteerbenchError(f"tracker: expected one of {', '.join(TRACKERS)}, got {name!r}")
    found = TRACKERS[name]
    if find_spec(found.package) is None:
        raise Unavailable(
            f"tracker={name} needs the package {found.package}: {install_command(name)}"
        )
    return found


def settings(run: Run) -> dict[str, Any]:
    """What was measured, by which command, at which commit and on which machine."""
    facts = {name: str(run.facts[name]) for name in FACTS}
    record = {name: run.record[name] for name in ("command", "commit")}
    return facts | record | {"cpu": run.record["machine"]["cpu"]}


def headline(run: Run) -> dict[str, float]:
    """The headline figures of the run, without missing ones."""
    return {name: value for name, value in run.values.items() if np.isfinite(value)}


def series(run: Run) -> Iterator[tuple[int, dict[str, float]]]:
    """The number of each frame and its figures, without missing ones."""
    for row in run.frames.select_dtypes("number").to_dict("records"):
        frame = int(row.pop("frame"))
        yield frame, {str(name): float(x) for name, x in row.items() if np.isfinite(x)}


def pictures(run: Run) -> Iterator[tuple[str, Path]]:
    """The files of the pictures, with names such as "rendered/0012"."""
    for path in sorted(run.pictures.glob("*.png")):
        frame, what = path.stem.split("-")
        yield f"{what}/{frame}", path
