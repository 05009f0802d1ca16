"""Scores existing pictures, from any program, in the same way as rendered frames."""

import hashlib
import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from glob import glob
from pathlib import Path
from typing import Any, Literal, NamedTuple
from unicodedata import normalize

import pandas as pd
import torch
from torch import Tensor

from bench.errors import not_there, some, unexpected
from bench.kinds import Rows, Size
from bench.metrics import Lpips, check_size
from bench.protocol import EvaluationProtocol
from bench.results import STEADY, Measurement, read_table
from bench.rows import phase_rows, row_table, score_rows
from bench.scenes.images import contents, decode_bytes
from bench.scenes.lookup import natural
from bench.scoring import PICTURES, Scoring
from bench.trajectories import resolution, spread
from bench.types import BACKGROUNDS, ByCamera, Camera, Log, Split, SteerbenchError, composite

SUFFIXES = (
    ".png", ".jpg", ".jpeg", ".webp", ".avif", ".bmp", ".gif", ".jp2", ".ppm", ".tif", ".tiff",
)  # fmt: skip
"""Endings of files that count as pictures; other files in a folder are ignored."""

MAP = re.compile(r"(.+)_(acc|accumulation|albedo|alpha|depth|disp|mask|normals?)(_\d+)?")
"""File names, without ending, of maps beside a picture, which are ignored: r_0_depth_0001."""

OF_A_RUN = re.compile(r"\d+-(rendered|truth|error)")
"""File names, without ending, of the pictures that a run keeps."""

Match = Literal["name", "order"]


class Pair(NamedTuple):
    """A file to score; `name`, `truth` (a file or uint8 [H, W, 3 or 4]) and, if known, `camera` and
    `mask` of its true picture."""

    picture: Path
    name: str
    truth: Path | Tensor
    camera: Camera | None = None
    mask: Tensor | None = None


def pairs_with_folder(pictures: Path, truth: Path, match: Match = "name") -> list[Pair]:
    """Pair each picture of the folder `truth` with its counterpart in `pictures`; see `matched`."""
    true = listed(truth)
    names = [path.relative_to(truth).as_posix() for path in true]
    return [Pair(*pair) for pair in zip(matched(pictures, names, match), names, true, strict=True)]


def pairs_with_split(pictures: Path, split: Split, match: Match = "name") -> list[Pair]:
    """Pair each picture of a scene's `split` with its counterpart in `pictures`; see `matched`."""
    files = matched(pictures, split.names, match)
    cameras: Sequence[Camera | None] = split.cameras or [None] * len(files)
    masks = split.masks or [None] * len(files)
    pairs = zip(files, split.names, split.images, cameras, masks, strict=True)
    return [Pair(*pair) for pair in pairs]


def matched(folder: Path, names: Sequence[str], match: Match) -> list[Path]:
    """The file of `folder` for each of `names`, without ending: by its path below the folder, or by
    its name if all are in the folder. Raises if one is missing, surplus or ambiguous."""
    files = listed(folder)
    if match == "order":
        if len(files) != len(names):
            raise unexpected(folder, f"{len(names)} pictures, as many as true ones", len(files))
        if sorted(names) == [*names] != sorted(names, key=natural) and sorted(files) != files:
            wanted = "numbers of one length in names, as true pictures are in the order of letters"
            raise unexpected(folder, wanted, some([path.name for path in files]))
        return files
    keys, names = _keys([path.relative_to(folder).as_posix() for path in files]), _keys(names)
    if not any("/" in key for key in keys):
        names = [Path(name).name for name in names]
    if twice := _repeated(names):
        wanted = "true pictures of different names; --match order takes both in their order"
        raise unexpected(folder, wanted, f"several of {some(twice)}")
    known = dict(zip(keys, files, strict=True))
    missing = [name for name in names if name not in known]
    further = sorted(known.keys() - set(names), key=natural)
    if missing or further:
        advice = "; --match order takes both in their order" if len(files) == len(names) else ""
        got = [f"none for {some(missing)}"] if missing else []
        got += [f"also {some(further)}"] if further else []
        raise unexpected(folder, "a picture for each true one", f"{', '.join(got)}{advice}")
    return [known[name] for name in names]


def _keys(names: Sequence[str]) -> list[str]:
    """`names` without ending, and without the folders that all of them are in."""
    names = [normalize("NFC", name.lstrip("/")) for name in names]  # not as macOS writes accents
    paths = [Path(name).with_suffix("") for name in names]
    shared = os.path.commonpath([str(path.parent) for path in paths] or [""])
    return [str(path.relative_to(shared)) for path in paths]


def below(folder: Path, pattern: str, endings: Sequence[str] = ()) -> list[Path]:
    """What is in a folder by a `pattern`, with one of the `endings` if there are any, 10 after 9:
    unlike what Path finds, without what is hidden, and through links."""
    names = sorted(glob(pattern, root_dir=folder, recursive=True), key=natural)  # noqa: PTH207
    return [folder / x for x in names if not endings or Path(x).suffix.lower() in endings]


def listed(folder: Path) -> list[Path]:
    """The pictures in a folder, if it has none in those below it, 10 after 9; raises if there are
    none, or two names differ in their ending."""
    if not folder.is_dir():
        raise not_there(folder, "a folder")
    files = below(folder, "*", SUFFIXES) or below(folder, "**/*", SUFFIXES)
    if not files:
        others = [path.relative_to(folder).as_posix() for path in below(folder, "**/*")]
        raise unexpected(folder, f"pictures ({', '.join(SUFFIXES)})", some(others) or "none")
    if wrong := [path for path in files if not str(path).isprintable()]:
        raise unexpected(folder, "names in UTF-8 that can be printed", repr(wrong[0].name))
    stems = [path.relative_to(folder).with_suffix("").as_posix() for path in files]
    if twice := _repeated(stems):
        raise unexpected(folder, "one picture of a name", f"several of {some(twice)}")
    maps = {stem for stem in stems if (of := MAP.fullmatch(stem)) and of[1] in stems}
    files = [path for path, stem in zip(files, stems, strict=True) if stem not in maps]
    if all(OF_A_RUN.fullmatch(path.stem) for path in files):
        raise SteerbenchError(
            f"{folder}: these are renderings, truths and error maps of a run, which is scored "
            "already: `steerbench results`; `steerbench compare` compares it with another run"
        )
    return files


def reported_times(file: Path, pairs: Sequence[Pair]) -> list[float]:
    """The time of each picture in milliseconds, the column `frame_ms` of a CSV file.

    With a column `name`, lines are matched by the name of the true picture, without its folder and
    ending, and others are ignored; without, there is one for each picture, in their order. Raises
    SteerbenchError if the file cannot be read, or a time is missing or not above 0.
    """
    table = read_table(file, skipinitialspace=True)
    if "frame_ms" not in table:
        raise unexpected(file, "a column frame_ms", ", ".join(map(str, table)) or "none")
    if "name" in table:
        table = table.dropna(subset="name").set_index("name")
        table.index = table.index.map(lambda name: Path(name).stem)
        names = [Path(pair.name).stem for pair in pairs]
        lines = Counter(table.index)
        if wrong := [name for name in names if lines[name] != 1 or names.count(name) > 1]:
            raise unexpected(file, "one line for each picture", f"none or several of {some(wrong)}")
        table = table.loc[names]
    times = pd.to_numeric(table["frame_ms"], errors="coerce").tolist()
    if len(times) != len(pairs):
        raise unexpected(file, f"{len(pairs)} lines, one for each picture", len(times))
    if not all(0 < ms < math.inf for ms in times):
        raise unexpected(f"{file}: frame_ms", "numbers above 0", table["frame_ms"].tolist())
    return times


def score(
    pairs: Sequence[Pair],
    protocol: EvaluationProtocol,
    lpips: Mapping[str, Lpips],
    facts: Mapping[str, Any],
    log: Log,
    *,
    sequence: bool = False,
    kept: int = PICTURES,
    surface: ByCamera | None = None,
    times: Sequence[float] = (),
) -> Measurement:
    """Score pictures under a protocol, on whose background any alpha is composited.

    `facts` (method, scene and so on) are for the rows. Pictures in `sequence` are consecutive
    frames, so that what needs those is scored, too; `surface` is that of their scene, if known.
    `times` in ms are as reported. So many pictures are `kept`, with truth and error map. Raises
    SteerbenchError if a picture cannot be read, or differs in size from its true picture.
    """
    background = torch.full((3,), BACKGROUNDS[protocol.background])
    scoring = Scoring(protocol, lpips, background, spread(len(pairs), kept), surface)
    frames: Rows = []
    sizes: list[Size] = []
    alphas = 0
    seen, truths = hashlib.sha256(), hashlib.sha256()
    with log.progress("scoring", len(pairs)) as progress:
        for index, (path, name, true, camera, mask) in enumerate(pairs):
            picture, truth = (
                decode_bytes(contents(x), x) if isinstance(x, Path) else x for x in (path, true)
            )
            _check(path, name, picture, truth, protocol)
            seen.update(picture.numpy().tobytes())
            truths.update(truth.numpy().tobytes())
            truths.update(b"" if mask is None else mask.numpy().tobytes())
            alphas += 4 in (picture.shape[2], truth.shape[2])
            rgb = composite(picture, background)
            figures = scoring.score(index, rgb, truth, cut=not sequence, camera=camera, mask=mask)
            frames.append({"frame": index, "name": name, "phase": STEADY, **figures})
            sizes.append((rgb.shape[1], rgb.shape[0]))
            progress.advance()
    if alphas:
        log.info(f"{alphas} pictures with an alpha channel were put on {protocol.background}")
    table = pd.DataFrame(frames).reindex(columns=["frame", "name", "phase", *scoring.names])
    if times:
        table["frame_ms"] = times
    of_frames = phase_rows(table) if times else score_rows(table, scoring.names)
    summary = [{**row, "phase": STEADY} for row in of_frames]
    rows = row_table(summary, resolution=resolution(sizes), protocol=protocol.name, **facts)
    record = {
        "protocol": asdict(protocol),
        "pictures": seen.hexdigest(),
        "truths": truths.hexdigest(),
        "with_alpha": alphas,
        "missing": scoring.missing([row["metric"] for row in summary if row["n"]]),
    }
    return Measurement(rows, table, scoring.images, record)


def _check(
    path: Path, name: str, picture: Tensor, truth: Tensor, protocol: EvaluationProtocol
) -> None:
    if picture.shape[:2] != truth.shape[:2]:
        wanted, got = (f"{image.shape[1]} x {image.shape[0]}" for image in (truth, picture))
        raise unexpected(path, f"{wanted} pixels, as {name} has", got)
    try:
        for metric in protocol.metric_names:
            check_size(metric, picture.shape[1], picture.shape[0])
    except SteerbenchError as error:
        raise SteerbenchError(f"{path}: {error}") from error


def _repeated(names: Sequence[str]) -> list[str]:
    return sorted((name for name, count in Counter(names).items() if count > 1), key=natural)
