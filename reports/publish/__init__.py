"""Writes a page in two forms: Markdown with pictures beside it, and one self-contained HTML file.

Both are made from the same parts, so that they show the same content: texts and cells of the HTML
page are rendered from Markdown, plots are drawn by the same code, as SVG. The files beside this
module are the page's templates, its style and its script.
"""

import base64
import hashlib
import io
import re
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain, pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
from jinja2 import Environment, FileSystemLoader
from markdown_it import MarkdownIt
from PIL import Image

from bench.errors import explained
from bench.sharing import whole
from reports.comparison import COST, shown_as, written
from reports.images import ZOOM, ComparedFrame, Part, Picture, still_images
from reports.runs import Repeated, Run, Runs
from reports.tables import QUALITY, Table

PICTURE = re.compile(r".+-[0-9a-f]{12}\.png")
"""File names of a page's pictures: a stem, then a digest of the content."""

HERE = FileSystemLoader(Path(__file__).parent)
TEMPLATES = Environment(loader=HERE, autoescape=True, trim_blocks=True, lstrip_blocks=True)

LOSSLESS_PIXELS = 800 * 800
"""Pictures up to this size are stored losslessly; larger ones would make the page too large."""

LOSSY_QUALITY = 90

PARSER = MarkdownIt("commonmark", {"html": False}).disable("image")
"""Images in texts are disabled, because pictures are parts of their own."""
TEMPLATES.filters["inline"] = PARSER.renderInline


def publish(parts: Sequence[Part], folder: Path, runs: Runs = ()) -> Path:
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
    still = (
        still_images(part) if isinstance(part, ComparedFrame) else [part]  # each image is a part
        for part in parts
    )
    texts = [_markdown(part, folder) for part in chain(*still)]
    return "\n\n".join(texts)


def _markdown(part: str | Table | Picture, folder: Path) -> str:
    """A part in Markdown; a picture is drawn into `folder`, and named after its content."""
    if isinstance(part, str):
        return part
    if isinstance(part, Table):
        return part.markdown()
    content = _drawn(part, "png")
    name = f"pictures/{part.stem}-{hashlib.sha256(content).hexdigest()[:12]}.png"
    (folder / "pictures").mkdir(exist_ok=True)
    with whole(folder / name) as new:
        new.write_bytes(content)
    return f"![{part.shows}]({name})"


def _drawn(picture: Picture, form: str) -> bytes:
    """The content of `picture` as a file of the `form` "png" or "svg"."""
    style: Any = {"svg.fonttype": "none", "svg.hashsalt": picture.stem, "text.parse_math": False}
    with tempfile.TemporaryDirectory() as place, matplotlib.rc_context(style):
        picture.draw(drawn := Path(place) / f"picture.{form}")
        return drawn.read_bytes()


def html_page(parts: Sequence[Part], runs: Runs) -> str:
    """The page of `parts` as HTML; the first begins with the title as a heading.

    `runs` are those whose keys occur in tables and marks.
    """
    origins = {run.key: _origin(run) for run in runs}
    headings: dict[str, str] = {}
    return TEMPLATES.get_template("page.html").render(
        title=str(parts[0]).partition("\n")[0].lstrip("# "),
        parts=[_html(part, origins, headings) for part in parts],
        headings=headings,
        opening=next((n for n, part in enumerate(parts) if isinstance(part, Table)), 0),
        origins=origins,
    )


def _origin(run: Run) -> dict[str, str]:
    line = Repeated(run.label, [run])
    figures = [
        f"{shown_as(metric).name} {written(line, metric)}"
        for metric in (*QUALITY, *COST)
        if metric in run.values
    ]
    chosen = ", ".join(f"{name}={value}" for name, value in run.settings.items())
    return {
        "method": str(run.facts["method"]),
        "figures": "; ".join(figures),
        "command": run.command,
        **run.provenance,
        **({"settings": chosen} if chosen else {}),
    }


def _html(part: Part, origins: dict[str, dict[str, str]], headings: dict[str, str]) -> str:
    """A part of the page as HTML; adds its second-level headings to `headings`, by id."""
    match part:
        case Table():
            return TEMPLATES.get_template("table.html").render(table=part, origins=origins)
        case Picture():
            return f'<div class="plot scrolls">{_svg(part)}</div>'
        case ComparedFrame():
            return _frame(part)
    tokens = PARSER.parse(part)
    for heading, text in pairwise(tokens):
        if heading.type == "heading_open" and heading.tag == "h2":
            heading.attrSet("id", name := f"part-{len(headings) + 1}")
            headings[name] = text.content
    return str(PARSER.renderer.render(tokens, PARSER.options, {}))


def _svg(plot: Picture) -> str:
    """`plot` as SVG; its marks can be focused and have descriptions."""
    content = _drawn(plot, "svg").decode()
    root = ElementTree.fromstring(content)
    used = set(re.findall(r"#([\w-]+)", content))
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # HTML needs no namespaces in <svg>
        element.attrib = {name.rpartition("}")[2]: of for name, of in element.attrib.items()}
        name = element.get("id", "")
        if name in plot.marks:
            says, runs = plot.marks[name]
            element.attrib |= {"class": "mark", "tabindex": "0", "role": "button"}
            element.attrib |= {"aria-label": says, "data-runs": " ".join(runs)}
            title = ElementTree.Element("title")
            title.text = says
            element.insert(0, title)
        if name not in used:  # another plot on the page may use the same id
            element.attrib.pop("id", None)
    root.remove(next(child for child in root if child.tag == "metadata"))
    root.attrib["style"] = f"--width: {root.attrib.pop('width')}"
    del root.attrib["height"]
    root.attrib |= {"role": "group" if plot.marks else "img", "aria-label": plot.shows}
    return ElementTree.tostring(root, encoding="unicode")


def _frame(frame: ComparedFrame) -> str:
    height, width = frame.truth.shape[:2]
    left, top, right, bottom = frame.box
    box = (left / width, top / height, (right - left) / width, (bottom - top) / height)
    return TEMPLATES.get_template("frame.html").render(
        frame=frame,
        views=[{"titles": ("ground truth",), "rendering": frame.truth}, *frame.views],
        width=width,
        height=height,
        box=" ".join(f"{edge:.4f}" for edge in box),
        zoom=ZOOM,
        lossy=LOSSY_QUALITY if height * width > LOSSLESS_PIXELS else None,
    )


def _uri(picture: np.ndarray) -> str:
    """uint8 [H, W, 3] as a data URI."""
    content = io.BytesIO()
    large = picture.shape[0] * picture.shape[1] > LOSSLESS_PIXELS
    quick = {"lossless": True, "method": 1}  # twice as fast as the default, 5 % larger
    how: dict[str, Any] = {"quality": LOSSY_QUALITY} if large else quick
    Image.fromarray(picture).save(content, "webp", **how)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"


TEMPLATES.filters["uri"] = _uri
