"""Writes a page in two forms: Markdown with pictures beside it, and one self-contained HTML file.

Both are made from the same parts, so that they show the same content.
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
from reports.parts import Frame, Part, Picture
from reports.runs import Run
from reports.tables import Table

PICTURE = re.compile(r".+-[0-9a-f]{12}\.png")
"""File names of a page's pictures: a stem, then a digest of the content."""


def publish(parts: Sequence[Part], folder: Path, runs: Sequence[Run] = ()) -> Path:
    """Write `parts` as `report.md` and `report.html`, each atomically; return the former.

    The first part begins with the title of the page as a heading. `runs` are those behind the
    figures; the HTML page shows their provenance. Pictures of an earlier page are kept until that
    page is replaced. Raises SteerbenchError if `folder` cannot be written to.
    """
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        text = markdown(parts, folder)
        for name, content in (("report.html", html_page(parts, runs)), ("report.md", f"{text}\n")):
            with whole(folder / name) as new:
                new.write_text(content, encoding="utf-8")
    for picture in (folder / "pictures").glob("*.png"):
        if PICTURE.fullmatch(picture.name) and f"(pictures/{picture.name})" not in text:
            with suppress(OSError):  # the page is already published
                picture.unlink()
    return folder / "report.md"


def markdown(parts: Sequence[Part], folder: Path) -> str:
    """`parts` in GitHub's Markdown; writes their pictures below `folder`."""
    texts: list[str] = []
    for part in parts:
        match part:
            case Table():
                texts.append(part.markdown())
            case Frame():
                texts += [_shown(picture, folder) for picture in still_images(part)]
            case Picture():
                texts.append(_shown(part, folder))
            case _:
                texts.append(part)
    return "\n\n".join(texts)


def _shown(picture: Picture, folder: Path) -> str:
    """Draw `picture` into `folder`, named after its content; return the Markdown that shows it."""
    with tempfile.TemporaryDirectory() as place:
        picture.draw(drawn := Path(place) / f"{picture.stem}.png")
        content = drawn.read_bytes()
    name = f"pictures/{picture.stem}-{hashlib.sha256(content).hexdigest()[:12]}.png"
    (folder / "pictures").mkdir(exist_ok=True)
    with whole(folder / name) as new:
        new.write_bytes(content)
    return f"![{picture.shows}]({name})"
