"""A page about measured runs: one table of all, pictures, and where every figure comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from bench.errors import explained
from bench.results import Store
from reports import figures
from reports.comparison import comparison, conditions_of
from reports.images import MOST_RENDERINGS, frame_section, kept_frames
from reports.publish import add_picture, publish
from reports.runs import Run, load
from reports.tables import Table, run_tables


def write_page(
    store: Store,
    labels: Mapping[str, str],
    folder: Path,
    failures: Mapping[str, str] | None = None,
) -> Path:
    """Write `folder/report.md` with its pictures, and the same as `report.html`; return the former.

    The page replaces an earlier one only when it is whole.

    Args:
        store: where the runs are.
        labels: the name of each run on the page, by its key, in the order of the page.
        folder: made if missing.
        failures: why a run is missing, by its label.

    Raises:
        SteerbenchError: a run is not in the store, or `folder` cannot be written to.
    """
    runs = load(store, labels)
    with explained(folder):
        stages = add_picture(folder, "stages", partial(figures.stage_bars, runs))
        parts = [
            _heading(runs, failures or {}),
            TIME.format(stages=stages),
            _pictures(runs, folder),
            *map(_figures, runs),
            _provenance(runs),
        ]
    return publish("\n\n".join(parts), folder)


TIME = """\
## Where the time goes

![Mean time of a frame in ms, one bar per run, divided into stages]({stages})

One bar per run: the mean time of a frame, divided into the stages of the method; a stage includes
the stages inside it. Time outside all stages is `other`."""


def _heading(runs: Sequence[Run], failures: Mapping[str, str]) -> str:
    """Title, the table of all runs and how to read it."""
    few = len(runs) <= MOST_RENDERINGS
    labels = ", ".join(run.label for run in runs) if few else f"{len(runs)} runs"
    scenes = ", ".join(dict.fromkeys(run.facts["scene"] for run in runs))
    table = comparison(runs, failures)
    scored, timed = (
        " / ".join(dict.fromkeys(str(run.headline["n"][metric]) for run in runs))
        for metric in ("psnr", "frame_ms")
    )
    reading = f"Arrows point to better. Quality is a mean over {scored} frames, time over {timed}."
    if table.bold:
        reading += (
            " The best figure of each column is **bold**, among runs with the same frames, protocol"
            " and machine."
        )
    title, conditions = f"# {labels} on {scenes}", f"Measured: {conditions_of(runs)}."
    return "\n\n".join((title, conditions, table.markdown(), reading, *missing_figures(runs)))


def missing_figures(runs: Sequence[Run]) -> list[str]:
    """A note for every metric that could not be measured."""
    notes = (f"{name}: n/a. {why}" for run in runs for name, why in run.record["missing"].items())
    return list(dict.fromkeys(notes))


def _pictures(runs: Sequence[Run], folder: Path) -> str:
    """Images of the kept frames; runs that rendered the same frames share them."""
    groups: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(run.views, []).append(run)
    parts = [
        text
        for number, group in enumerate(groups.values(), 1)
        for frame in kept_frames(group[0])
        for text in frame_section(group, frame, f"frames-{number}", folder)
    ]
    return "\n\n".join(("## Pictures", *(parts or ["No frame has a ground truth."])))


def _figures(run: Run) -> str:
    """All figures of one run."""
    tables = (table.section(level=3) for table in run_tables(run.rows))
    return "\n\n".join((f"## {run.label}, run {run.key}", *tables))


def _provenance(runs: Sequence[Run]) -> str:
    """The commands, then one line for each fact that all runs share, one per run for others."""
    commands = "\n".join(dict.fromkeys(run.record["command"] for run in runs))
    facts = [_facts(run) for run in runs]
    lines = []
    for name in facts[0]:
        values = [of_run[name] for of_run in facts]
        if len(set(values)) == 1:
            lines.append((name, values[0]))
        else:
            lines += [
                (f"{name}, {run.label}", value) for run, value in zip(runs, values, strict=True)
            ]
    table = Table("Provenance", ("", ""), tuple(lines), figures=False)
    return f"""\
## Provenance

Every figure and picture on this page was made by

```sh
{commands}
```

{table.markdown()}"""


def _facts(run: Run) -> dict[str, str]:
    """Where the figures of a run come from, by name."""
    machine, record, row = run.record["machine"], run.record, run.facts
    memory = f"{machine['memory_bytes'] / 2**30:.0f} GiB"
    computed = {name: row[name] for name in ("device", "backend", "engine", "precision")}
    return {
        "run": run.key,
        "scene": f"{row['scene']}, digest {record['scene']['digest'][:16]}",
        "frames": f"{row['trajectory']} at {row['resolution']}",
        "protocol": _listed(record["protocol"]),
        "budget": _listed(record["budget"]),
        "seed": str(row["seed"]),
        "commit": row["commit"],
        "computed on": _listed(computed),
        "peak memory": record["peak_bytes"],
        "machine": f"{machine['cpu']}, {machine['threads']} threads, {memory}",
        "GPU": ", ".join(machine["gpus"]) or "none",
        "system": f"{machine['system']}, Python {machine['python']}",
        "versions": _listed(record["made_of"].get("libraries", {})),
    }


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name} {' + '.join(value) if isinstance(value, list) else value}"
        for name, value in values.items()
    )
