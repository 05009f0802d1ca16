"""Both forms of a page: the same words, and nothing that the HTML page would have to fetch."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import pytest
from PIL import Image

from bench.types import SteerbenchError
from reports.publish import publish

TEXT = (
    "# Title & more\n\n| a | b |\n| --- | ---: |\n| x | 1 < 2 |\n\n![what it shows](pictures/p.png)"
)


def test_the_html_page_holds_tables_and_pictures_itself(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    Image.new("RGB", (2, 2)).save(tmp_path / "pictures" / "p.png")
    assert publish(TEXT, tmp_path) == tmp_path / "report.md"
    assert (tmp_path / "report.md").read_text() == f"{TEXT}\n"
    page = (tmp_path / "report.html").read_text()
    assert "<title>Title &amp; more</title>" in page
    assert "1 &lt; 2</td>" in page
    (source,) = re.findall(r'<img src="data:image/png;base64,([^"]+)" alt="what it shows"', page)
    assert base64.b64decode(source) == (tmp_path / "pictures" / "p.png").read_bytes()


def test_a_page_that_cannot_be_made_leaves_the_earlier_one(tmp_path: Path) -> None:
    publish("# First", tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(SteerbenchError, match=r"p\.png"):
        publish(TEXT, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
