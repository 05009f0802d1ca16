"""A page in its two forms: Markdown with its pictures beside it, one HTML file that holds all."""

from __future__ import annotations

import base64
import hashlib
import html
import re
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from markdown_it import MarkdownIt

from bench.errors import explained
from bench.sharing import whole

STYLE = """\
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 80rem; margin: 2rem auto;
       padding: 0 1rem }
table { border-collapse: collapse; display: block; overflow-x: auto; font-size: 13px }
th, td { border: 1px solid #ccc; padding: 2px 8px; text-align: left; white-space: nowrap }
td[style*=right] { font-variant-numeric: tabular-nums }
img { max-width: 100% }
pre { background: #f4f4f4; padding: 8px; overflow-x: auto }"""


PICTURE = re.compile(r".+-[0-9a-f]{12}\.png")
"""What `add_picture` calls its files."""


def add_picture(folder: Path, stem: str, draw: Callable[[Path], object]) -> str:
    """Have `draw` write a PNG, and keep it for a page in `folder`; the name it has for the page.

    It is one of its content, so that the pictures of an earlier page stay until that is replaced.
    """
    with tempfile.TemporaryDirectory() as place:
        draw(drawn := Path(place) / f"{stem}.png")
        content = drawn.read_bytes()
    name = f"pictures/{stem}-{hashlib.sha256(content).hexdigest()[:12]}.png"
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    with whole(folder / name) as new:
        new.write_bytes(content)
    return name


def publish(text: str, folder: Path) -> Path:
    """Write `text` as `report.md` and `report.html`, each of which appears whole or not at all;
    return the former.

    Pictures that `text` shows lie below `folder`; the HTML page holds them itself. Those of an
    earlier page are deleted last.

    Raises:
        SteerbenchError: `folder` cannot be written to.
    """
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in (("report.html", _page(text, folder)), ("report.md", f"{text}\n")):
            with whole(folder / name) as new:
                new.write_text(content, encoding="utf-8")
    for picture in (folder / "pictures").glob("*.png"):
        if PICTURE.fullmatch(picture.name) and f"(pictures/{picture.name})" not in text:
            with suppress(OSError):  # the page is published
                picture.unlink()
    return folder / "report.md"


def _page(text: str, folder: Path) -> str:
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(text)
    for picture in (child for token in tokens for child in token.children or ()):
        if picture.type == "image":
            content = base64.b64encode((folder / str(picture.attrs["src"])).read_bytes())
            picture.attrs["src"] = f"data:image/png;base64,{content.decode()}"
    title = html.escape(text.partition("\n")[0].lstrip("# "))
    body = parser.renderer.render(tokens, parser.options, {})
    return f"""\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{STYLE}
</style>
</head>
<body>
{body}</body>
</html>
"""
