"""A page about measured runs: tables, pictures, and where every figure comes from."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from bench.results import COLD, Store, explained
from reports import figures, tables

PANELS = {"truth": "ground truth", "rendered": "rendering", "error": "error"}
"""Caption of each picture of a frame, by the end of its file name."""


def write_page(store: Store, runs: Sequence[str], folder: Path) -> Path:
    """Write `folder/report.md` about `runs`, with its pictures beside it, and return its path.

    The page replaces an earlier one only when it is whole.

    Raises:
        SteerbenchError: a run is not in the store, or `folder` cannot be written to.
    """
    records: dict[str, Any] = {run: store.record(run) for run in runs}
    rows = store.rows(report=lambda unreadable: None)  # others, which are not asked for
    rows = rows[rows["run"].isin(runs)]
    pictures = folder / "pictures"
    with explained(folder):
        pictures.mkdir(parents=True, exist_ok=True)
        for stale in pictures.glob("run*-*-*.png"):  # of an earlier page
            stale.unlink()
        figures.stage_bars(rows, pictures / "stages.png")
        parts = [_heading(rows, records)]
        for number, run in enumerate(runs, 1):
            shown = _copy_pictures(store.folder / run / "pictures", pictures, f"run{number}-")
            of_run = rows[rows["run"] == run]
            parts.append(_section(of_run, records[run], store.frames(run), shown))
        partial = folder / ".report.md.partial"
        partial.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
        return partial.replace(folder / "report.md")


def _heading(rows: pd.DataFrame, records: Mapping[str, Any]) -> str:
    commands = "\n".join(dict.fromkeys(record["command"] for record in records.values()))
    scenes = ", ".join(dict.fromkeys(rows["scene"]))
    methods = ", ".join(dict.fromkeys(rows["method"]))
    return f"""\
# {methods} on {scenes}

Every figure and picture on this page was made by

```sh
{commands}
```

{tables.overview(rows).markdown()}

![Mean time of a frame, divided into stages](pictures/stages.png)"""


def _section(
    rows: pd.DataFrame, record: Mapping[str, Any], frames: pd.DataFrame, shown: Mapping[int, str]
) -> str:
    """Tables, pictures and provenance of one run."""
    blocks = "\n\n".join(
        f"### {table.title}\n\n{table.markdown()}" for table in tables.blocks(rows)
    )
    missing = "".join(f"\n\n{name}: n/a. {why}" for name, why in record["missing"].items())
    return f"""\
## Run {record["run"]}

{blocks}{missing}

### Pictures

Error maps show the {record["error_map"]}.

{_pictures(frames, shown).markdown()}

### Provenance

{_provenance(rows.iloc[0], record).markdown()}"""


def _copy_pictures(source: Path, target: Path, prefix: str) -> dict[int, str]:
    """Copy the pictures of a run; for each frame, how their names begin in `target`."""
    for picture in source.glob("*.png"):
        shutil.copyfile(picture, target / f"{prefix}{picture.name}")
    frames = sorted(picture.name.split("-")[0] for picture in source.glob("*-truth.png"))
    return {int(frame): f"{prefix}{frame}" for frame in frames}


def _pictures(frames: pd.DataFrame, shown: Mapping[int, str]) -> tables.Table:
    """One line per shown frame: name and PSNR, ground truth, rendering, error map."""
    by_frame = frames.set_index("frame").to_dict("index")
    lines = tuple(
        (
            _caption(by_frame[frame]),
            *(f"![{caption}](pictures/{stem}-{panel}.png)" for panel, caption in PANELS.items()),
        )
        for frame, stem in shown.items()
    )
    return tables.Table("Pictures", ("frame", *PANELS.values()), lines, figures=False)


def _caption(frame: Mapping[Any, Any]) -> str:
    cold = ", cold" if frame["phase"] == COLD else ""
    return f"{frame['name']}, {frame['psnr']:.2f} dB{cold}"


def _provenance(row: pd.Series, record: Mapping[str, Any]) -> tables.Table:
    """Where the figures come from, line by line."""
    machine = record["machine"]
    memory = f"{machine['memory_bytes'] / 2**30:.0f} GiB"
    lines = (
        ("scene", f"{row['scene']}, digest {record['scene']['digest'][:16]}"),
        ("frames", f"{row['trajectory']} at {row['resolution']}"),
        ("protocol", _listed(record["protocol"])),
        ("budget", _listed(record["budget"])),
        ("seed", str(row["seed"])),
        ("commit", row["commit"]),
        (
            "computed on",
            _listed({name: row[name] for name in ("device", "backend", "engine", "precision")}),
        ),
        ("peak memory", record["peak_bytes"]),
        ("machine", f"{machine['cpu']}, {machine['threads']} threads, {memory}"),
        ("GPU", ", ".join(machine["gpus"]) or "none"),
        ("system", f"{machine['system']}, Python {machine['python']}"),
        ("versions", _listed(machine["versions"])),
    )
    return tables.Table("Provenance", ("", ""), lines, figures=False)


def _listed(values: Mapping[str, Any]) -> str:
    texts = (" + ".join(value) if isinstance(value, list) else value for value in values.values())
    return ", ".join(f"{name} {text}" for name, text in zip(values.keys(), texts, strict=True))
