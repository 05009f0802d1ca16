"""Which pictures of a capture are for training and which for tests: every nth, or as lists say."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.errors import unexpected
from bench.records import read_text
from bench.scenes.files import describe, whole_number
from bench.scenes.images import View
from bench.scenes.lookup import bare, found, tidy
from bench.types import Log

Listed = Sequence[tuple[str, View | None]]
"""The pictures that a file lists, by name; None: it is not there."""

Lists = tuple[Path, Mapping[str, Sequence[str]]]
"""A file, and the names of pictures that it lists for each split."""

SPLITS = ("train", "val", "test")


def read_lists(
    root: Path, split: str | None, record: Mapping[str, Any], where: Path
) -> Lists | None:
    """The names in the lines of the file `split`: of test pictures, or of others if it is called
    train* or val*; without it train_filenames ... in `record`, the file `where`; None: no lists."""
    if split is None:
        given = {name: record.get(f"{name}_filenames") for name in SPLITS}
        lists = {name: entries for name, entries in given.items() if entries}
        for name, entries in lists.items():
            if not isinstance(entries, list) or not all(isinstance(x, str) for x in entries):
                raise unexpected(f"{where}: {name}_filenames", "a list of names", describe(entries))
        return (where, lists) if lists else None
    here = Path(str(split))
    file = here if here.is_file() else found(root, str(split), "scene.split", "a file of names")
    lines = map(str.strip, read_text(file).splitlines())
    names = [line for line in lines if line and not line.startswith("#")]
    if not names:
        raise unexpected(file, "names of pictures", "none")
    return file, {next((of for of in SPLITS if file.stem.lower().startswith(of)), "test"): names}


def divide(
    listed: Listed, step: int, lists: Lists | None, where: Path, log: Log
) -> dict[str, list[View]]:
    """Split pictures, by name: as `lists` say; or 0, step, 2 step ... test, the others train.

    Missing pictures are counted, so that the others stay where they are. Raises SteerbenchError if
    nothing is left to train on or to test.
    """
    whole_number(step, "split_every", 2)
    listed = sorted(listed, key=lambda one: one[0])
    if lists:
        parts = _as_listed([name for name, _ in listed], *lists, log)
    else:
        tests = {*range(0, len(listed), step)}
        parts = {"train": {*range(len(listed))} - tests, "test": tests}
    views = {
        split: [view for i, (_, view) in enumerate(listed) if i in parts[split] and view]
        for split in SPLITS
        if split in parts
    }
    for split, purpose in (("train", "train on"), ("test", "test")):
        if not views[split]:
            got = f"no file for {split}, which has {len(parts[split])} of {len(listed)} pictures"
            raise unexpected(where, f"a picture to {purpose}", got)
    return views


def _as_listed(
    names: Sequence[str], file: Path, lists: Mapping[str, Sequence[str]], log: Log
) -> dict[str, set[int]]:
    """The positions in `names` that each split lists; a split without a list has what is left."""
    whole = [bare(name) for name in names]
    last = [Path(name).name for name in whole]
    parts, unknown, rest = dict[str, set[int]](), set[str](), {*range(len(names))}
    for split, entries in lists.items():
        wanted, keys = {bare(tidy(entry)) for entry in entries}, whole
        if not wanted & {*whole} and len({*last}) == len({*whole}):  # in another folder
            wanted, keys = {Path(name).name for name in wanted}, last
        parts[split] = {index for index, key in enumerate(keys) if key in wanted}
        unknown |= wanted - {*keys}
        if not parts[split]:
            expected = f"names of its pictures, such as {names[0]}"
            raise unexpected(f"{file}: {split}", expected, f"'{entries[0]}'")
        rest -= parts[split]
    if "test" not in parts and "val" in parts:
        parts["test"] = parts.pop("val")
    for split in {"train", "test"} - {*parts}:
        parts[split], rest = rest, set()
    counts = ", ".join(f"{len(part)} {split}" for split, part in parts.items())
    said = [f"{file}: pictures as it lists them: {counts}"]
    said += [f"in no list, left out: {len(rest)}"] if rest else []
    said += [f"no pictures: {', '.join(sorted(unknown))}"] if unknown else []
    log.info("; ".join(said))
    return parts
