"""Data sets that others publish: downloads them, checks copies of them.

`scenes/published.toml` describes them, `scenes/*.registry.txt` have the SHA-256 of each file.
"""

import tempfile
import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from bench.download import fetch
from bench.errors import unexpected
from bench.scenes.files import data_folder
from bench.sharing import file_sha256, locked
from bench.threads import in_parallel
from bench.types import Log, Unavailable

LISTS = Path(__file__).parent / "scenes"
GROUND_TRUTH = ("_depth_", "_normal_")  # pictures that no loader reads; an archive may lack them


@dataclass(frozen=True)
class Published:
    """A data set, as `published.toml` describes it."""

    name: str
    layout: str  # the value of `scene=` that reads its scenes
    licence: str
    archive: str | None = None  # URL of a zip file with the folder of one `{scene}`; or
    folder: str | None = None  # URL of the folder with all files

    @cached_property
    def hashes(self) -> Mapping[str, str]:
        """SHA-256 of each file, by its path, which starts with the scene's name."""
        text = (LISTS / f"{self.name}.registry.txt").read_text(encoding="utf-8")
        return dict(line.split() for line in text.splitlines())

    @property
    def scenes(self) -> set[str]:
        return {name.split("/")[0] for name in self.hashes}

    def of(self, scene: str) -> dict[str, str]:
        return {name: d for name, d in self.hashes.items() if name.startswith(f"{scene}/")}


def published() -> list[Published]:
    content = tomllib.loads((LISTS / "published.toml").read_text(encoding="utf-8"))
    return [Published(name, **about) for name, about in content.items()]


def get(data: Published, scene: str, folder: Path, log: Log) -> Path:
    """Download a scene of `data` into `folder` / `scene`, keeping correct files; see `fetch`."""
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
            which = (
                f"{len(wrong)} of {len(wanted)} missing or with another SHA-256, {wrong[0]} first"
            )
            raise Unavailable(f"{archive.name}: expected the published files, got {which}")
        for name in there:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(new) / name).replace(folder / name)


def _wrong(folder: Path, wanted: Mapping[str, str]) -> list[str]:
    """The `wanted` files that are present but differ, or missing although a loader needs them."""
    needed = [n for n in wanted if (folder / n).exists() or not any(m in n for m in GROUND_TRUTH)]
    return [name for name in needed if file_sha256(folder / name) != wanted[name]]


@dataclass(frozen=True)
class VerifyReport:
    """A copy of a data set, compared with its registry: files by their path in the release."""

    ok: Sequence[str]
    wrong: Sequence[str]  # of other content, or cannot be read
    missing: Sequence[str]
    extra: Sequence[str]  # not on the list

    @property
    def passed(self) -> bool:
        """Whether no file is wrong. Missing files do not count: perhaps they were never copied."""
        return bool(self.ok) and not self.wrong

    def __str__(self) -> str:
        return ", ".join(f"{len(names)} {kind}" for kind, names in vars(self).items())


def verify(path: str | Path, log: Log) -> VerifyReport:
    """Check the whole release, or one scene of it, by its name; raises if `path` is neither."""
    root = data_folder(path)
    base, expected = _expected(root)
    files = (file for file in root.rglob("*") if file.is_file())
    inside = (file for file in files if file.resolve().is_relative_to(root))
    present = {file.relative_to(base).as_posix() for file in inside}
    known = sorted(present & expected.keys())
    digests = in_parallel(file_sha256, [base / name for name in known], "verify", log)
    right = {name for name, digest in zip(known, digests, strict=True) if digest == expected[name]}
    return VerifyReport(
        ok=[name for name in known if name in right],
        wrong=[name for name in known if name not in right],
        missing=sorted(expected.keys() - present),
        extra=sorted(present - expected.keys()),
    )


def _expected(root: Path) -> tuple[Path, Mapping[str, str]]:
    """The folder that the listed paths are relative to, and the list of hashes."""
    known = published()
    for data in known:
        if root.name in data.scenes:
            return root.parent, data.of(root.name)
        if any((root / scene).is_dir() for scene in data.scenes):
            return root, data.hashes
    folders = sorted(scene for data in known for scene in data.scenes)
    raise unexpected(root, f"a folder {' or '.join(folders)}, or one above", "none of these names")
