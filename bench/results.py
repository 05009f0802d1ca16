"""The store of runs, `outputs/runs/<key>/`, and the tidy table made from all of them.

A run folder holds `rows.csv` (one metric per row, `COLUMNS`), `frames.csv` (one frame per row),
`record.json` (what the key was made of, commit, machine, what the figures mean), `pictures/`, and
`SHA256SUMS` of all of them, which is checked whenever one is read. It gets its final name only when
it is complete. `used.json` alone changes afterwards: when the run was last asked for, and by which
jobs.
"""

import hashlib
import io
import json
import os
import shutil
import time
import uuid
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from bench.errors import SteerbenchError, explained, not_there, reason, some, unexpected
from bench.kinds import Say
from bench.provenance import commit, machine
from bench.records import Record, read_record
from bench.sharing import check_sums, whole, write_sums

SCHEMA_VERSION = 5  # of record.json and rows.csv; other folders are reported and skipped

COLUMNS = [
    *("run", "method", "scene", "split", "trajectory", "resolution", "protocol", "budget"),
    *("phase", "metric", "unit", "value", "n", "lo", "hi"),
    *("device", "backend", "engine", "precision", "field_precision"),
    *("seed", "commit"),
]
"""`value` is a mean over `n` frames with its 95 % interval [lo, hi], or a single figure (n = 1,
no interval). NaN with n = 0 means not available. `phase` says which frames: "steady", "cold" (with
fewer preceding frames than the method looks back on), or "all" for a figure of the whole run.
`device` is "reported" where others measured the times."""

STEADY, COLD, WHOLE = "steady", "cold", "all"  # the values of the column `phase`
REPORTED = "reported"  # as `device`: others measured the times

FRAME = ("frame", "name", "phase")  # the first columns of frames.csv
FIGURES = {"value": "float64", "lo": "float64", "hi": "float64", "n": "int64", "seed": "int64"}
RECORD, ROWS, FRAMES = "record.json", "rows.csv", "frames.csv"
USED = "used.json"
PARTIAL = ".partial-"
STALE_S = 24 * 3600.0


def content_key(parts: Mapping[str, object]) -> str:
    """SHA-256 of `parts`, regardless of their order; they must be JSON values without NaN."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Measurement:
    """The figures and pictures of one run."""

    rows: pd.DataFrame  # one metric per row, `COLUMNS` without `run` and `commit`
    frames: pd.DataFrame  # one frame per row; NaN where a figure does not exist for that frame
    pictures: dict[str, np.ndarray]  # uint8 [H, W, 3] by file name without `.png`
    record: Mapping[str, object]  # what the figures mean; JSON values only


class Store:
    """All runs under `root` (`outputs`)."""

    def __init__(self, root: Path) -> None:
        self.folder = root / "runs"

    def key(self, parts: Mapping[str, object]) -> str:
        """The key of a run, made of `parts`: everything that can change its rows."""
        return content_key(parts)[:16]

    def find(self, key: str) -> Path | None:
        """The folder of a complete run, or None."""
        folder = self.folder / key
        return folder if (folder / RECORD).is_file() else None

    def intact(self, key: str) -> bool:
        """Whether there is a complete run, whose files are as they were stored."""
        with suppress(SteerbenchError):
            if folder := self.find(key):
                check_sums(folder)
                return True
        return False

    def whole_key(self, beginning: str) -> str:
        """The key of the only run whose key starts with `beginning`; raises unless there is one."""
        wanted = Path(beginning).name  # the key may be given as the path of its folder
        keys = [p.name for p in self.folder.glob(f"{escape(wanted)}*") if self.find(p.name)]
        if len(keys) != 1:
            got = f"{len(keys)} runs below {self.folder}; see `steerbench results`"
            raise unexpected(f"run {beginning!r}", "the beginning of one key", got)
        return keys[0]

    def save(self, parts: Mapping[str, object], measurement: Measurement) -> str:
        """Write the run made of `parts`, unless it is there, and return its key; raises as `write`
        does."""
        key = self.key(parts)
        if self.find(key):
            return key
        record = {
            "schema_version": SCHEMA_VERSION,
            "run": key,
            "commit": commit(),
            "stored": time.time(),
            "machine": machine(),
            "made_of": parts,
            **measurement.record,
        }
        rows = measurement.rows.assign(run=key, commit=commit())[COLUMNS]
        with self.write(key) as folder:
            rows.to_csv(folder / ROWS, index=False, lineterminator="\n")
            measurement.frames.to_csv(folder / FRAMES, index=False, lineterminator="\n")
            (folder / "pictures").mkdir()
            for name, pixels in measurement.pictures.items():
                Image.fromarray(pixels).save(folder / "pictures" / f"{name}.png")
            (folder / RECORD).write_text(json.dumps(record, indent=2, allow_nan=False) + "\n")
        return key

    @contextmanager
    def write(self, key: str) -> Iterator[Path]:
        """A temporary folder that becomes the run `key` if the body ends without an exception.

        A result that another process has finished in the meantime is kept. Raises SteerbenchError
        if there is no space or no permission, or `outputs` is no folder.
        """
        with explained(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._sweep()
            partial = self.folder / f"{PARTIAL}{key}-{uuid.uuid4().hex[:8]}"
            partial.mkdir()
            try:
                yield partial
                write_sums(partial)
                for path in [*partial.rglob("*"), partial]:
                    _sync(path)
                folder = self.folder / key
                if folder.exists() and self.find(key) is None:  # half deleted, or half copied
                    shutil.rmtree(folder)
                try:
                    partial.replace(folder)
                except OSError:
                    if self.find(key) is None:
                        raise
                _sync(self.folder)
            finally:
                shutil.rmtree(partial, ignore_errors=True)

    def remove(self, key: str) -> None:
        removed = self.folder / f"{PARTIAL}{key}-{uuid.uuid4().hex[:8]}"
        with suppress(FileNotFoundError):
            (self.folder / key).replace(removed)  # at once: nobody reads half of it
            shutil.rmtree(removed, ignore_errors=True)

    def rows(
        self,
        report: Say = lambda line: None,
        keys: Collection[str] | None = None,
    ) -> pd.DataFrame:
        """Every row of all runs, or of those in `keys`; `report` gets a line on those that cannot
        be read, for each reason."""
        bodies: list[str] = []
        left_out: dict[str, list[str]] = {}
        for folder in sorted(self.folder.glob("[!.]*")):
            if keys is not None and folder.name not in keys:
                continue
            try:
                bodies.append(_body(folder))
            except SteerbenchError as error:
                left_out.setdefault(str(error), []).append(folder.name)
        for why, names in left_out.items():
            report(f"{self.folder}: left out: {some(names)}: {why}")
        return pd.read_csv(
            io.StringIO("\n".join((",".join(COLUMNS), "".join(bodies)))),
            dtype={column: FIGURES.get(column, "str") for column in COLUMNS},
            keep_default_na=False,
            na_values={column: ["", "nan"] for column in ("value", "lo", "hi")},
        )

    def frames(self, run: str) -> pd.DataFrame:
        """The frames of a run, which have the columns `FRAME`."""
        check_sums(folder := self._existing(run), [FRAMES])
        return read_table(folder / FRAMES, keep_default_na=False, na_values=[""])

    def record(self, run: str) -> Record:
        """The record of a run: what it was made of, and on which machine."""
        check_sums(folder := self._existing(run), [RECORD])
        record: Record = read_record(folder / RECORD)
        return record

    def use(self, run: str, *jobs: str) -> None:
        """Note that the run was asked for now, by `jobs` with these keys; not where others own the
        store."""
        path, (_, before) = self._existing(run) / USED, self.used(run)
        held = {"used": time.time(), "jobs": sorted({*before, *jobs})}
        with suppress(OSError), whole(path) as new:
            new.write_text(json.dumps(held) + "\n", encoding="utf-8")

    def used(self, run: str) -> tuple[float, list[str]]:
        """When a run was last asked for, in seconds, and the keys of all jobs that asked for it."""
        try:
            held = json.loads(_text(self.folder / run / USED))
            return float(held["used"]), list(held["jobs"])
        except (ValueError, KeyError, TypeError):  # stored and never asked for
            return 0.0, []

    def _sweep(self) -> None:
        """Delete what killed processes left behind: partial folders older than a day."""
        with suppress(OSError):  # other processes publish and delete meanwhile
            for folder in self.folder.glob(f"{PARTIAL}*"):
                if time.time() - folder.stat().st_mtime > STALE_S:
                    shutil.rmtree(folder, ignore_errors=True)

    def _existing(self, run: str) -> Path:
        if folder := self.find(run):
            return folder
        raise SteerbenchError(f"no run {run!r} in {self.folder}: see `steerbench results`")


def read_table(path: Path, **how: Any) -> pd.DataFrame:
    """The table in a CSV file, whose column `name` is text; SteerbenchError if it cannot be read.
    `how` is for `pandas.read_csv`."""
    if not path.is_file():
        raise not_there(path)
    try:
        return pd.read_csv(path, dtype={"name": "str"}, **how)
    except (OSError, ValueError) as error:
        raise unexpected(path, "a table", reason(error)) from error


def existing_store(root: Path) -> Store:
    """The store below `root`, to read from; SteerbenchError if it has no runs."""
    store, unread = Store(root), [f"`steerbench run outputs={root}` makes one"]
    names = (folder.name for folder in store.folder.glob("[!.]*"))
    if all(store.rows(lambda _: None, [name]).empty for name in names):  # the first one suffices
        store.rows(unread.append)
        there = "no runs to read" if store.folder.is_dir() else "there is no store of runs"
        raise SteerbenchError(f"{root}: {there}; {unread[-1]}")
    return store


def _body(folder: Path) -> str:
    """The rows of a run as lines of text; SteerbenchError says why they cannot be read."""
    try:
        schema = json.loads(_text(folder / RECORD))["schema_version"]
    except (ValueError, KeyError, TypeError) as error:
        raise unexpected(RECORD, "a record with a schema_version", "a damaged one") from error
    if schema != SCHEMA_VERSION:
        raise SteerbenchError(
            f"stored by another version of steerbench (schema {schema}, this one reads "
            f"{SCHEMA_VERSION}); measure again, with outputs=DIR to keep what is there"
        )
    check_sums(folder, [RECORD, ROWS])
    body = _text(folder / ROWS).partition("\n")[2]
    if (run := body.partition(",")[0]) != folder.name:
        raise unexpected(ROWS, "the run that its folder is named after", run)
    return body


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""


def _sync(path: Path) -> None:
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
