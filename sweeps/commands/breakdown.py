"""`steerbench breakdown`: the time of a frame by its parts, for each precision."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import compress

from omegaconf import DictConfig

from bench.accuracy import steady_frames
from bench.clock import OTHER
from bench.study import Study
from bench.types import NullProbe
from bench.waits import Line, device_waits
from reports.tables import Table, decimal, spread
from sweeps import variants
from sweeps.execute import Launcher
from sweeps.overrides import composed, folder_words, holds
from sweeps.processes import on_gpu
from sweeps.terminal import print_rows, show
from sweeps.variants import Row

DENSE = ", nothing skipped"  # suffix of a line whose method skips nothing


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line; or the same of waits."""
    words, launcher = variants.settings(options, variants.METHOD, "trajectory=smooth")
    words = with_engine(words)
    if options.device_waits:
        return _print_waits(words, options.frames, launcher)
    config = composed(words)
    study = variants.declared(config)
    wanted = _lines(words)
    if study.skips:
        wanted |= _lines([*words, *variants.nothing_skipped(study)], DENSE)
    configs = [composed([*folder_words(words), *of]) for of in study.beside.values()]
    shared = [word for word in words if holds(word, configs)]  # settings that all of them have
    for name, of_method in study.beside.items():
        wanted |= _lines([*shared, *of_method], f", {name}")
    rendered = variants.render(wanted, options, launcher)
    rows = [_row(each, composed(wanted[each["setting"]]), config.budget) for each in rendered]
    parts = _parts(study, rows)
    columns = ("", *parts, "frame ↓", "of rounds", "p99 / p50 ↓", "FPS ↑", "PSNR, dB ↑")
    title = f"ms of a frame, and what of it each part takes itself; {rendered[0]['frames']} frames"
    show(Table(title, columns, tuple(_cells(row, parts) for row in rows)))
    print_rows(rows)
    return 0


def _print_waits(words: Sequence[str], frames: int, launcher: Launcher) -> int:
    """Print how often the host waits for the GPU in a steady frame, by the line that causes it."""
    with device_waits():
        pass  # raises without a GPU before anything is trained
    (waits,) = launcher.run(partial(_waits, frames=frames), [words])
    total = sum(waits, Counter[Line]())
    rows: list[Row] = [
        {"waits": count / len(waits), "line": line.place, "source": line.source}
        for line, count in total.most_common()
    ]
    lines = tuple((decimal(row["waits"], 1), row["line"], row["source"]) for row in rows)
    title = f"{decimal(total.total() / len(waits), 1)} waits a frame, mean of {len(waits)}"
    show(Table(title, ("waits", "line", "source"), lines))
    print_rows(rows)
    return 0


def _waits(words: Sequence[str], frames: int) -> list[Counter[Line]]:
    """Where the host waits in each steady frame of a second round: the first sets things up."""
    with variants.fitted({variants.AS_IT_IS.name: words}, frames) as (methods, ground, _):
        (method,) = methods.values()
        for _ in range(2):
            method.reset()
            counted = []
            for step in ground.trajectory.steps:
                with device_waits() as waits:
                    method.render(step.camera, NullProbe())
                counted.append(waits)
        ready, _ = steady_frames([method], ground.trajectory)
        return list(compress(counted, ready))


def with_engine(words: Sequence[str]) -> list[str]:
    """`words`, preceded by the engine with the most precisions on the device that they name."""
    device = str(composed(words).get("device"))
    return ["engine=torch" if on_gpu(device) else "engine=openvino", *words]


def _lines(words: Sequence[str], ending: str = "") -> dict[str, list[str]]:
    """The words of a line for each precision of the engine; of one line without an engine."""
    config = composed(words, return_hydra_config=True)
    if "engine" not in config.method:
        return {ending.removeprefix(", ") or variants.AS_IT_IS.name: list(words)}
    chosen = f"engine={config.hydra.runtime.choices.engine}"
    own = [variant for variant in variants.engines(words) if chosen in variant.settings]
    return {f"{name}{ending}": of for name, of in variants.words_of(words, own).items()}


def _row(rendered: Row, config: DictConfig, budget: DictConfig) -> Row:
    """One line; its PSNR is left out if it has another budget than the first line."""
    study = variants.declared(config)
    parts: dict[str, float] = {}
    for metric, value in rendered.items():
        if metric.startswith("stage_ms."):
            part = study.part_of(metric.removeprefix("stage_ms."))
            parts[part] = parts.get(part, 0.0) + value
    return {
        "line": rendered["setting"],
        "parts": parts,
        "network_ms": rendered.get(f"stage_ms.{study.network_stage}"),
        **variants.times(rendered),
        "psnr": rendered["psnr"] if config.budget == budget else None,
    }


def _parts(study: Study, rows: Iterable[Row]) -> list[str]:
    """The parts that occur in any line: first those that the method declares, `other` last."""
    there = dict.fromkeys(part for row in rows for part in row["parts"])
    named = [part for part in dict.fromkeys(study.parts.values()) if part in there]
    return [*named, *(part for part in there if part not in (*named, OTHER)), OTHER]


def _cells(row: Row, parts: Iterable[str]) -> tuple[str, ...]:
    return (
        row["line"],
        *(decimal(row["parts"].get(part, 0.0), 1) for part in parts),
        decimal(row["frame_ms"], 1),
        spread(row["ms_lo"], row["ms_hi"]),
        decimal(row["p99_to_p50"], 2),
        decimal(1e3 / row["frame_ms"], 2),
        decimal(row["psnr"], 2),
    )
