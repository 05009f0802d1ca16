"""A page in its two forms: Markdown with its pictures beside it, one HTML file that holds all."""

from __future__ import annotations

import base64
import html
from pathlib import Path

from markdown_it import MarkdownIt

from bench.results import explained
from bench.sharing import whole

STYLE = """\
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 80rem; margin: 2rem auto;
       padding: 0 1rem }
table { border-collapse: collapse; display: block; overflow-x: auto; font-size: 13px }
th, td { border: 1px solid #ccc; padding: 2px 8px; text-align: left; white-space: nowrap }
td[style*=right] { font-variant-numeric: tabular-nums }
img { max-width: 100% }
pre { background: #f4f4f4; padding: 8px; overflow-x: auto }"""


def publish(text: str, folder: Path) -> Path:
    """Write `text` as `report.md` and `report.html`, each of which appears whole or not at all;
    return the former.

    Pictures that `text` shows lie below `folder`; the HTML page holds them itself.

    Raises:
        SteerbenchError: `folder` cannot be written to.
    """
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in (("report.html", _page(text, folder)), ("report.md", f"{text}\n")):
            with whole(folder / name) as new:
                new.write_text(content, encoding="utf-8")
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
