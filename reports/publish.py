"""A page in its two forms: Markdown with its pictures beside it, one HTML file that holds all.

Both are written from the same parts, so neither can show what the other does not.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from bench.errors import explained
from bench.sharing import whole
from reports.html import html_page
from reports.images import still_images
from reports.parts import Frame, Part, Picture, Plot
from reports.runs import Run
from reports.tables import Table

PICTURE = re.compile(r".+-[0-9a-f]{12}\.png")
"""What the pictures of a page are called: a stem, then a digest of the content."""


def publish(parts: Sequence[Part], folder: Path, runs: Sequence[Run] = ()) -> Path:
    """Write `parts` as `report.md` and `report.html`, each of which appears whole or not at all;
    return the former.

    Pictures of an earlier page stay until that is replaced.

    Args:
        parts: the page from top to bottom; it begins with its title as a heading.
        folder: made if missing.
        runs: those behind the figures, whose origin the HTML page has at hand.

    Raises:
        SteerbenchError: `folder` cannot be written to.
    """
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        text = markdown(parts, folder)
        for name, content in (("report.html", html_page(parts, runs)), ("report.md", f"{text}\n")):
            with whole(folder / name) as new:
                new.write_text(content, encoding="utf-8")
    for picture in (folder / "pictures").glob("*.png"):
        if PICTURE.fullmatch(picture.name) and f"(pictures/{picture.name})" not in text:
            with suppress(OSError):  # the page is published
                picture.unlink()
    return folder / "report.md"


def markdown(parts: Sequence[Part], folder: Path) -> str:
    """`parts` in GitHub's Markdown, their pictures written below `folder`."""
    return "\n\n".join(_markdown(part, folder) for part in parts)


def _markdown(part: Part, folder: Path) -> str:
    match part:
        case Table():
            return part.markdown()
        case Frame():
            return "\n\n".join(_shown(picture, folder) for picture in still_images(part))
        case Plot():
            return _shown(part, folder)
    return part


def _shown(picture: Picture, folder: Path) -> str:
    """Draw `picture` into `folder`, named after its content; the Markdown that shows it."""
    with tempfile.TemporaryDirectory() as place:
        picture.draw(drawn := Path(place) / f"{picture.stem}.png")
        content = drawn.read_bytes()
    name = f"pictures/{picture.stem}-{hashlib.sha256(content).hexdigest()[:12]}.png"
    (folder / "pictures").mkdir(exist_ok=True)
    with whole(folder / name) as new:
        new.write_bytes(content)
    return f"![{picture.shows}]({name})"
