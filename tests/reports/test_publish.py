"""Both forms of a page: the same parts, and an earlier page that stays until there is another."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.types import SteerbenchError
from reports.images import Part, Plot
from reports.publish import publish
from reports.tables import Table

TABLE = Table("t", ("a", "b"), (("x", "1 < 2"),))
PARTS: list[Part] = ["# Title & more", TABLE]


def test_a_page_is_written_in_both_forms(tmp_path):
    assert publish(PARTS, tmp_path) == tmp_path / "report.md"
    assert (tmp_path / "report.md").read_text() == f"# Title & more\n\n{TABLE.markdown()}\n"
    page = (tmp_path / "report.html").read_text()
    assert "<title>Title &amp; more</title>" in page
    assert "1 &lt; 2</td>" in page


def test_a_page_that_cannot_be_made_leaves_the_earlier_one(tmp_path):
    publish(["# First"], tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}

    def full(path: Path) -> None:
        raise OSError(28, "No space left on device", str(path))

    with pytest.raises(SteerbenchError, match=r"plot\.png: No space left"):
        publish([*PARTS, Plot("plot", "nothing", full)], tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("form", ["report.md", "report.html"])
def test_a_form_that_cannot_be_written_is_the_same_plain_error(tmp_path, form):
    (tmp_path / form / "in the way").mkdir(parents=True)
    with pytest.raises(SteerbenchError, match=f"cannot write to {tmp_path}"):
        publish(PARTS, tmp_path)
    assert [path.name for path in tmp_path.glob(".*")] == []
