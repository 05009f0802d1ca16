"""A page about measured runs: one table of all, pictures, and where every figure comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from bench.results import Store, explained
from reports import figures, tables
from reports.comparison import comparison, setting
from reports.pictures import BESIDE, beside, shown_frames
from reports.publish import add_picture, publish
from reports.runs import Run, load


def write_page(
    store: Store,
    labels: Mapping[str, str],
    folder: Path,
    failures: Mapping[str, str] | None = None,
) -> Path:
    """Write `folder/report.md` with its pictures beside it, and return its path; the same as
    `report.html`.

    The page replaces an earlier one only when it is whole.

    Args:
        store: where the runs are.
        labels: what each run is called, by its key, in the order of the page.
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

One bar per run: the mean time of a frame, divided into the stages of the method; a stage holds
those inside it. What was spent between the stages is `other`."""


def _heading(runs: Sequence[Run], failures: Mapping[str, str]) -> str:
    """Title, the table of all runs and how to read it."""
    labels = ", ".join(run.label for run in runs) if len(runs) <= BESIDE else f"{len(runs)} runs"
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
    notes = dict.fromkeys(
        f"{name}: n/a. {why}" for run in runs for name, why in run.record["missing"].items()
    )
    texts = (
        f"# {labels} on {scenes}",
        f"Measured: {setting(runs)}.",
        table.markdown(),
        reading,
        *notes,
    )
    return "\n\n".join(texts)


def _pictures(runs: Sequence[Run], folder: Path) -> str:
    """Pictures of the shown frames; runs that rendered the same frames share them."""
    groups: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(run.views, []).append(run)
    parts = [
        text
        for number, group in enumerate(groups.values(), 1)
        for frame in shown_frames(group[0])
        for text in beside(group, frame, f"frames-{number}", folder)
    ]
    return "\n\n".join(("## Pictures", *(parts or ["No frame has a ground truth."])))


def _figures(run: Run) -> str:
    """All figures of one run."""
    blocks = "\n\n".join(
        f"### {table.title}\n\n{table.markdown()}" for table in tables.blocks(run.rows)
    )
    return f"## {run.label}, run {run.key}\n\n{blocks}"


def _provenance(runs: Sequence[Run]) -> str:
    """Commands, then where the figures come from: a line for what all have in common."""
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
    table = tables.Table("Provenance", ("", ""), tuple(lines), figures=False)
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
    texts = (" + ".join(value) if isinstance(value, list) else value for value in values.values())
    return ", ".join(f"{name} {text}" for name, text in zip(values.keys(), texts, strict=True))
