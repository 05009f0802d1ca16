"""Which pictures of a capture are for training and which for tests: every nth, or as lists say."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.errors import unexpected
from bench.scenes.files import describe, read_json, read_text, whole_number
from bench.scenes.images import View
from bench.scenes.lookup import absent, bare, tidy
from bench.types import Log

Listed = Sequence[tuple[str, View | None]]
"""The pictures that a file lists, by name; None: it is not there."""

Lists = tuple[Path, Mapping[str, Sequence[str]]]
"""A file, and the names of pictures that it lists for each split."""

SPLITS = ("train", "val", "test")


def read_lists(
    root: Path, split: str | None, record: Mapping[str, Any], where: Path
) -> Lists | None:
    """The lists in the file `split`; without it train_filenames ... in `record`, the file `where`.

    A file of JSON has lists train, val and test, or those of `record`; any other has a name in each
    line: of test pictures; if it is called train* or val*, of those. None if `record` has no lists,
    or `split` is "every".
    """
    if split == "every":
        return None
    file = where
    if split is not None:
        file = next(filter(os.path.isfile, (root / str(split), Path(str(split)))), Path())
        if not file.name:
            raise unexpected("scene.split", "a file of names", absent(root, str(split)))
        if file.suffix.lower() == ".json":
            record = read_json(file.parent, file.name)
        else:
            lines = map(str.strip, read_text(file.parent, file.name).splitlines())
            of = next((name for name in SPLITS if file.stem.startswith(name)), "test")
            record = {of: [line for line in lines if line and not line.startswith("#")]}
    given = {name: record.get(f"{name}_filenames") or record.get(name) for name in SPLITS}
    lists = {name: entries for name, entries in given.items() if entries}
    for name, entries in lists.items():
        if not isinstance(entries, list) or not all(isinstance(entry, str) for entry in entries):
            raise unexpected(f"{file}: {name}", "a list of names", describe(entries))
    if split is not None and not lists:
        raise unexpected(file, "names of pictures", "none")
    return (file, lists) if lists else None


def divide(
    listed: Listed, step: int, lists: Lists | None, where: Path, log: Log
) -> dict[str, list[View]]:
    """Split pictures, by name: as `lists` say; or 0, step, 2 step ... test, the others train.

    Missing pictures are counted, so that the others stay where they are. Raises SteerbenchError if
    nothing is left to train on or to test.
    """
    whole_number(step, "split_every", 2)
    order = sorted(range(len(listed)), key=lambda index: listed[index][0])
    if lists:
        parts = _as_listed([name for name, _ in listed], *lists, log)
    else:
        parts = {"train": {i for n, i in enumerate(order) if n % step}, "test": set(order[::step])}
    views = {
        split: [view for i in order if i in parts[split] and (view := listed[i][1])]
        for split in SPLITS
        if split in parts
    }
    for split, purpose in (("train", "train on"), ("test", "test")):
        if not views[split]:
            got = f"none of {len(parts[split])} among {len(listed)}"
            raise unexpected(where, f"a picture to {purpose}", got)
    return views


def _as_listed(
    names: Sequence[str], file: Path, lists: Mapping[str, Sequence[str]], log: Log
) -> dict[str, set[int]]:
    """The positions in `names` that each split lists; a split without a list has what is left."""
    places: dict[str, set[int]] = {}  # of whole paths, and of last parts; both without endings
    for index, name in enumerate(names):
        for key in {bare(name), f"*/{Path(bare(name)).name}"}:
            places.setdefault(key, set()).add(index)
    parts: dict[str, set[int]] = {}
    unknown = []
    for split, entries in lists.items():
        parts[split] = set()
        for name in (bare(tidy(entry)) for entry in entries):
            last = places.get(f"*/{Path(name).name}", set())
            found = places.get(name) or (last if len(last) == 1 else set())
            parts[split] |= found
            unknown += [] if found else [name]
        if not parts[split]:
            expected = f"names of its pictures, such as {names[0]}"
            raise unexpected(f"{file}: {split}", expected, f"'{entries[0]}'")
    rest = set(range(len(names))).difference(*parts.values())
    if "test" not in parts and "val" in parts:
        parts["test"] = parts.pop("val")
    for split in {"train", "test"} - {*parts}:
        parts[split], rest = rest, set()
    counts = ", ".join(f"{len(part)} {split}" for split, part in parts.items())
    both = len(parts["train"] & parts["test"])
    log.info(
        f"{file}: pictures as it lists them: {counts}"
        + f"; {both} of them in train and test" * bool(both)
        + f"; in no list, left out: {len(rest)}" * bool(rest)
        + f"; no pictures: {', '.join(unknown)}" * bool(unknown)
    )
    return parts
