"""Compares a copy of a published data set with the SHA-256 list of the release."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.scenes.files import data_folder, unexpected
from bench.scenes.parallel import in_parallel
from bench.scenes.published import published, sha256
from bench.types import Log


@dataclass(frozen=True)
class VerifyReport:
    """The result of a check: lists of files by their path in the release.

    Attributes:
        ok: present, with the official content.
        wrong: present, but with other content or unreadable.
        missing: on the list, but not present.
        extra: present, but not on the list.
    """

    ok: Sequence[str]
    wrong: Sequence[str]
    missing: Sequence[str]
    extra: Sequence[str]

    @property
    def passed(self) -> bool:
        """Whether no file is wrong. Missing files do not count: perhaps they were never copied."""
        return bool(self.ok) and not self.wrong

    def __str__(self) -> str:
        counts = ("ok", "wrong", "missing", "extra")
        return ", ".join(f"{len(getattr(self, name))} {name}" for name in counts)


def verify(path: str | Path, log: Log) -> VerifyReport:
    """Check the whole release, or one scene of it; folder names tell which.

    Raises SteerbenchError if `path` looks like neither.
    """
    root = data_folder(path)
    base, expected = _expected(root)
    present = {
        file.relative_to(base).as_posix()
        for file in root.rglob("*")
        if file.is_file() and file.resolve().is_relative_to(root)
    }
    known = sorted(present & expected.keys())
    digests = in_parallel(sha256, [base / name for name in known], "verify", log)
    right = {name: found == expected[name] for name, found in zip(known, digests, strict=True)}
    return VerifyReport(
        ok=[name for name in known if right[name]],
        wrong=[name for name in known if not right[name]],
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
