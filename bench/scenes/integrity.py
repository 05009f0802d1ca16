"""Compares a copy of NeRF-Synthetic with the SHA-256 list of the release."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.scenes.files import data_folder, unexpected
from bench.scenes.parallel import in_parallel
from bench.types import Log

LIST = Path(__file__).with_name("nerf_synthetic.sha256.txt")


@dataclass(frozen=True)
class VerifyReport:
    """The result of a check: files by their path in the release.

    Attributes:
        ok: there, with the official content.
        wrong: there, with other content or not readable.
        missing: on the list and not there.
        extra: there and not on the list.
    """

    ok: Sequence[str]
    wrong: Sequence[str]
    missing: Sequence[str]
    extra: Sequence[str]

    @property
    def passed(self) -> bool:
        """Whether no file differs; files that are missing were perhaps never copied."""
        return bool(self.ok) and not self.wrong

    def __str__(self) -> str:
        counts = ("ok", "wrong", "missing", "extra")
        return ", ".join(f"{len(getattr(self, name))} {name}" for name in counts)


def verify(path: str | Path, log: Log) -> VerifyReport:
    """Check the whole release, or one scene of it, as the names of the folders say.

    Raises SteerbenchError when `path` does not look like either.
    """
    root, expected = data_folder(path), official_hashes()
    scenes = {name.split("/")[0] for name in expected}
    if any((root / scene).is_dir() for scene in scenes):
        base = root
    elif root.name in scenes:
        base = root.parent
        expected = {k: v for k, v in expected.items() if k.split("/")[0] == root.name}
    else:
        expected_text = f"NeRF-Synthetic: a folder {' or '.join(sorted(scenes))}, or one above"
        raise unexpected(root, expected_text, "none of these names")
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


def official_hashes() -> dict[str, str]:
    """SHA-256 by path in the release."""
    lines = (line.split(maxsplit=1) for line in LIST.read_text().splitlines())
    return {name: digest for digest, name in lines}


def sha256(path: Path) -> str | None:
    """SHA-256 of a file's content; None when it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
