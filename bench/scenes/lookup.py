"""Finds the files that a data set names in the words of other tools, systems and machines."""

import os
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path, PurePosixPath
from unicodedata import normalize

from bench.errors import unexpected
from bench.types import Log

ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
"""Of pictures, in the order in which they are tried where a name has none or another one."""

There = Callable[[Path], bool]  # whether something is there: os.path.isfile or isdir


def tidy(name: str) -> str:
    """A path with "/" for "\\", and without "./"."""
    return str(PurePosixPath(name.replace("\\", "/")))


def bare(name: str) -> str:
    """A name without the ending of a picture."""
    stem, _, ending = name.rpartition(".")
    return stem if stem and f".{ending.lower()}" in ENDINGS else name


def natural(name: str) -> list[tuple[int, str]]:
    """A sort key that orders numbers in names as numbers."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def in_any_case(path: Path, there: There = os.path.isfile) -> Path | None:
    """`path`, or what differs from it only in the case of letters; None if that is not `there`."""
    if there(path):
        return path
    folder = None if path == path.parent else in_any_case(path.parent, os.path.isdir)
    like = (child for child in _children(folder) if child.name.casefold() == path.name.casefold())
    return next(filter(there, like), None)


def found(
    root: Path, name: str, where: str | Path, kind: str, there: There = os.path.isfile
) -> Path:
    """What is called `name` in `root`, in any case of letters; raises if that is not `there`."""
    path = in_any_case(root / tidy(name), there)
    if path is None:
        raise unexpected(where, kind, absent(root, name))
    return path


def _children(folder: Path | None) -> list[Path]:
    """What is in a folder; nothing if it cannot be read."""
    try:
        return sorted(folder.iterdir()) if folder else []
    except OSError:
        return []


def find_all(root: Path, names: Sequence[str]) -> list[Path | None]:
    """The picture of each of `names` from the folder `root`; None if there is none.

    It is called like that, perhaps with "/" for "\\"; or in another case of letters, or with an
    ending of a picture where `names` have none or another one. No picture is that of two names.
    """

    def key(name: str) -> str:
        return normalize("NFC", bare(name)).casefold()  # not as macOS writes accents

    @cache
    def beside(folder: Path) -> dict[str, list[Path]]:
        files = defaultdict(list)
        there = _children(in_any_case(folder, os.path.isdir))
        there = [file for file in there if bare(file.name) != file.name]
        for file in sorted(there, key=lambda file: ENDINGS.index(file.suffix.lower())):
            files[key(file.name)].append(file)
        return files

    files = {name: next(filter(os.path.isfile, [root / name]), None) for name in names}
    taken = set(files.values())
    for name in [name for name, file in files.items() if not file]:
        path = root / tidy(name)
        like = sorted(
            beside(path.parent).get(key(path.name), []),
            key=lambda file: (file != path, file.name.casefold() != path.name.casefold()),
        )
        files[name] = next((file for file in like if file not in taken), None)
        taken.add(files[name])
    return [files[name] for name in names]


def report(
    root: Path,
    names: Sequence[str],
    files: Sequence[Path | None],
    where: str,
    log: Log,
    every: bool,
) -> None:
    """Log which pictures are missing or called otherwise; raises if none is there, or not `every`
    one. `files` are those of `names` in `root`, as from `find_all`."""
    missing = [name for name, file in zip(names, files, strict=True) if not file]
    if not any(files) or (every and missing):
        got = f"{len(missing)} of {len(names)} not there: {absent(root, missing[0])}"
        raise unexpected(where, "pictures", got)
    renamed = [
        f"{file.name} for {name}"
        for name, file in zip(map(tidy, names), files, strict=True)
        if file and PurePosixPath(name).name not in (file.name, bare(file.name))
    ]
    for some, how in ((missing, "are not there, left out"), (renamed, "have another name")):
        if some:
            listed = ", ".join(some[:9]) + ", ..." * (len(some) > 9)
            log.info(f"{where}: {len(some)} of {len(names)} pictures {how}: {listed}")


def absent(root: Path, name: str) -> str:
    """Says that `name` is not in `root`, and what is there that is most like it."""
    parts = [part for part in PurePosixPath(tidy(name)).parts if part != "/"]
    ends = (root.joinpath(*parts[start:]) for start in range(1, len(parts)))
    near = [*filter(os.path.isfile, ends)][:1]  # in the folder of another machine
    if not near:
        folder = next(filter(os.path.isdir, root.joinpath(*parts).parents))
        there = {child.name: child for child in _children(folder)}
        first = root.joinpath(*parts).relative_to(folder).parts[0]
        near = [there[each] for each in get_close_matches(first, there, 1) or [*there][:3]]
    return f"no '{name}' in {root}; nearest: {', '.join(map(str, near)) or 'nothing'}"
