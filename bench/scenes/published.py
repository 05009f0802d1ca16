"""Published data sets: where to download them, and the SHA-256 of each file."""

from __future__ import annotations

import hashlib
import tempfile
import tomllib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from bench.download import fetch
from bench.errors import Unavailable
from bench.sharing import locked
from bench.types import Log

HERE = Path(__file__).parent
GROUND_TRUTH = ("_depth_", "_normal_")
"""Marks in the names of pictures that no loader reads; an archive may lack these pictures."""


@dataclass(frozen=True)
class Published:
    """A data set, as `published.toml` describes it.

    Attributes:
        archive: URL of a zip file with the folder of one `{scene}`; or
        folder: URL of the folder with all files.
        layout: the value of `scene=` that reads its scenes.
        licence: the licence of the data.
    """

    name: str
    layout: str
    licence: str
    archive: str | None = None
    folder: str | None = None

    @cached_property
    def hashes(self) -> Mapping[str, str]:
        """SHA-256 of each file, by its path, which starts with the scene's name."""
        text = (HERE / f"{self.name}.sha256.txt").read_text()
        lines = (line.split(maxsplit=1) for line in text.splitlines())
        return {name: digest for digest, name in lines}

    @property
    def scenes(self) -> set[str]:
        """The names of the scenes."""
        return {name.split("/")[0] for name in self.hashes}

    def of(self, scene: str) -> dict[str, str]:
        """The part of `hashes` that belongs to `scene`."""
        return {name: d for name, d in self.hashes.items() if name.split("/")[0] == scene}


def published() -> list[Published]:
    """All known published data sets."""
    content = tomllib.loads((HERE / "published.toml").read_text(encoding="utf-8"))
    return [Published(name, **about) for name, about in content.items()]


def sha256(path: Path) -> str | None:
    """SHA-256 of a file's content; None if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


def get(data: Published, scene: str, folder: Path, log: Log) -> Path:
    """Download a scene of `data` into `folder` / `scene`.

    Correct existing files are kept, and an interrupted download is resumed.

    Raises:
        Unavailable: no answer, the connection breaks off, or files have other content.
        OSError: `folder` cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = data.of(scene)
    with locked(folder / ".lock", f"waits for another process that fills {folder}", log):
        if data.folder is not None:
            with log.progress(f"downloading {scene}", len(wanted)) as progress:
                for name, digest in wanted.items():
                    fetch(data.folder + name, folder / name, digest, log)
                    progress.advance()
        elif data.archive is not None and _wrong(folder, wanted):
            archive = fetch(data.archive.format(scene=scene), folder / f"{scene}.zip", None, log)
            try:
                _unpack(archive, wanted, folder)
            finally:  # no longer needed, or damaged
                archive.unlink()
    return folder / scene


def _unpack(archive: Path, wanted: Mapping[str, str], folder: Path) -> None:
    """Extract the `wanted` files, if they are correct, from the zip file into `folder`."""
    with tempfile.TemporaryDirectory(dir=folder) as new:
        try:
            with zipfile.ZipFile(archive) as file:
                there = [name for name in file.namelist() if name in wanted]
                file.extractall(new, there)
        except (zipfile.BadZipFile, EOFError) as error:
            raise Unavailable(f"{archive.name}: expected a zip file, {error}; try again") from error
        if wrong := _wrong(Path(new), wanted):
            raise Unavailable(
                f"{archive.name}: expected the published files, {len(wrong)} of {len(wanted)} are "
                f"missing or have another SHA-256, {wrong[0]} the first of them"
            )
        for name in there:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(new) / name).replace(folder / name)


def _wrong(folder: Path, wanted: Mapping[str, str]) -> list[str]:
    """The `wanted` files that are present but differ, or missing although a loader needs them."""
    return [name for name, digest in wanted.items() if _differs(folder / name, digest)]


def _differs(path: Path, digest: str) -> bool:
    optional = any(mark in path.name for mark in GROUND_TRUTH)
    return sha256(path) != digest if path.exists() else not optional
