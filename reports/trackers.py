"""Sends a run of the store to an experiment tracker, under the run's key.

Each tracker gets the figures of every frame as a series, the headline figures as a summary, the
pictures and the provenance. A run already sent under the same key is replaced or kept.
"""

import shutil
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

from bench.errors import SteerbenchError, Unavailable, install_command
from reports.runs import Run


def to_wandb(run: Run, outputs: Path) -> None:
    """Weights & Biases: a run with the key as id. W&B's environment variables set the target."""
    import wandb

    facts = settings(run)
    begun = wandb.init(
        project="steerbench", id=run.key, name=run.label, config=facts, dir=outputs, resume="allow"
    )
    with begun as sent:
        for frame, figures in series(run):
            sent.log(figures, step=frame)
        sent.log({name: wandb.Image(str(path)) for name, path in pictures(run)})
        sent.summary.update(headline(run))


def to_tensorboard(run: Run, outputs: Path) -> None:
    """TensorBoard: event files in OUTPUTS/tensorboard/KEY, written once, and all or none."""
    from torch.utils.tensorboard import SummaryWriter

    folder = outputs / "tensorboard" / run.key
    if folder.exists():
        return
    begun = folder.with_name(f".{run.key}")
    shutil.rmtree(begun, ignore_errors=True)
    with SummaryWriter(str(begun)) as writer:
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
    begun.replace(folder)


TRACKERS = {"wandb": to_wandb, "tensorboard": to_tensorboard}
"""What sends a run from the store in the folder `outputs`, by the tracker's name and package."""


def tracker(name: str) -> Callable[[Run, Path], None]:
    """What sends a run to the tracker called `name`; raises if it is unknown or not installed."""
    if name not in TRACKERS:
        raise SteerbenchError(f"tracker: expected one of {', '.join(TRACKERS)}, got {name!r}")
    if find_spec(name) is None:
        raise Unavailable(f"tracker={name} needs the package {name}: {install_command(name)}")
    return TRACKERS[name]


def settings(run: Run) -> dict[str, str]:
    """What was measured, by which command, at which commit and on which machine."""
    facts = {str(name): str(fact) for name, fact in run.facts.items()}
    return facts | {"command": run.record["command"], "cpu": run.record["machine"]["cpu"]}


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
