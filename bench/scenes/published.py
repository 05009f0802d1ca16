"""Published data sets: where they can be had, and the SHA-256 of each of their files."""

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
"""In the names of pictures that no scene is read from: an archive may lack them."""


@dataclass(frozen=True)
class Published:
    """A data set, as `published.toml` describes it.

    Attributes:
        archive: the address of a zip file with the folder of one `{scene}`; or
        folder: the address below which each file lies.
        layout: the choice of `scene=` that reads its scenes.
        licence: under which it may be used.
    """

    name: str
    layout: str
    licence: str
    archive: str | None = None
    folder: str | None = None

    @cached_property
    def hashes(self) -> Mapping[str, str]:
        """The SHA-256 of each file by its path, which begins with the name of its scene."""
        text = (HERE / f"{self.name}.sha256.txt").read_text()
        lines = (line.split(maxsplit=1) for line in text.splitlines())
        return {name: digest for digest, name in lines}

    @property
    def scenes(self) -> set[str]:
        """The names of the scenes."""
        return {name.split("/")[0] for name in self.hashes}

    def of(self, scene: str) -> dict[str, str]:
        """The part of `hashes` that is of one scene."""
        return {name: d for name, d in self.hashes.items() if name.split("/")[0] == scene}


def published() -> list[Published]:
    """All that are known."""
    content = tomllib.loads((HERE / "published.toml").read_text(encoding="utf-8"))
    return [Published(name, **about) for name, about in content.items()]


def sha256(path: Path) -> str | None:
    """SHA-256 of a file's content; None when it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


def get(data: Published, scene: str, folder: Path, log: Log) -> Path:
    """Download a scene of `data` into `folder` / `scene`. Files that are there and right are kept,
    and what an interrupted call got is used.

    Raises:
        Unavailable: no answer, an answer that breaks off, or files of another content.
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
            finally:  # it is not needed any more, or not what it should be
                archive.unlink()
    return folder / scene


def _unpack(archive: Path, wanted: Mapping[str, str], folder: Path) -> None:
    """Move the files on the list, if they are right, from the zip file into `folder`."""
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
    """The files on the list that are needed and missing, or there and not right."""
    return [name for name, digest in wanted.items() if _differs(folder / name, digest)]


def _differs(path: Path, digest: str) -> bool:
    optional = any(mark in path.name for mark in GROUND_TRUTH)
    return sha256(path) != digest if path.exists() else not optional
