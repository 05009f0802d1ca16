"""The page: complete, with pictures that are there, in both forms, and never half-written."""

import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pandas as pd
import pytest
from PIL import Image

from reports import figures
from reports.images import Part
from reports.lines import Lines
from reports.page import _ablations, write_page
from reports.publish import publish
from reports.runs import Repeated
from reports.tables import Table
from tests.common import refusal
from tests.reports.conftest import rewrite, run_of

TABLE = Table("t", ("a", "b"), (("x", "1 < 2"),))
PARTS: list[Part] = ["# Title & more", TABLE]


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def linked(page: Path) -> list[Path]:
    """The pictures a page shows: all there are beside it, and each can be read."""
    names = re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())
    found = [page.parent / name for name in names]
    for path in found:
        Image.open(path).load()
    assert set((page.parent / "pictures").iterdir()) == set(found)
    return found


@pytest.fixture
def page(store, stored_run, tmp_path) -> Path:
    return write_page(store, [stored_run], tmp_path / "page")


@pytest.mark.parametrize("form", ["report.md", "report.html"])
def test_a_form_that_cannot_be_written_is_the_same_plain_error(tmp_path, form):
    (tmp_path / form / "in the way").mkdir(parents=True)
    with refusal(f"cannot write to {tmp_path}"):
        publish(PARTS, tmp_path)
    assert [path.name for path in tmp_path.glob(".*")] == []


def test_the_page_says_how_it_was_made_and_where_its_figures_come_from(page, stored_run):
    assert len(linked(page)) == 1 + 3  # the bar, then three frames
    text = page.read_text()
    for fact in (
        "# offset on tiny",
        "```sh\nsteerbench run method=offset\n```",
        f"## offset, run {stored_run}",
        "| scene | tiny, digest 0123456789abcdef |",
        "| frames | test at 40x32 |",
        "| seed | 5 |",
        "lpips_alex: n/a. no weights were found",
        "absolute error, mean over the channels",
        "Python 3.",
    ):
        assert fact in text


def test_a_page_is_written_over_an_earlier_one_and_leaves_nothing_else(page, store, stored_run):
    before = files(page.parent)
    (page.parent / "pictures/frames-7-0042-0-0123456789ab.png").touch()  # of an earlier page
    write_page(store, [stored_run], page.parent)
    assert files(page.parent) == before


def test_an_interrupted_page_leaves_the_earlier_one_with_its_pictures(page, several, monkeypatch):
    before = files(page.parent)
    with monkeypatch.context() as patch:
        patch.setattr("reports.publish.html_page", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            write_page(*several, page.parent)
    assert before.items() <= files(page.parent).items()
    write_page(*several, page.parent)
    assert linked(page)


def test_a_page_of_several_runs_has_all_of_them_beside_each_other(several, tmp_path):
    store, labels = several
    page = write_page(store, labels, tmp_path / "page", {"gone": "no memory"})
    text = page.read_text()
    assert text.startswith("# first, copy 0, copy 1, copy 2, copy 3, copy 4 on tiny\n")
    plots, frames = linked(page)[:3], linked(page)[3:]
    assert [path.stem[:-13] for path in plots] == ["psnr-ms", "psnr-bytes", "stages"]
    assert len(frames) == 3 * 2  # at most four runs in each
    firsts = {path.stem.split("-")[-2] for path in frames}
    assert firsts == {"0", "3"}  # and as many in either
    assert "gone: failed: no memory" in text
    for key, label in labels.items():
        assert f"\n| {label} |" in text
        assert f"| run, {label} | {key} |" in text
    # What all runs have in common is listed once.
    assert text.count("steerbench run seed=5") == 1
    assert text.count("| seed | 5 |") == 1
    assert "| machine, copy 4 | another," in text


def test_runs_that_differ_in_frames_or_figures_share_no_picture_and_no_plot(several, tmp_path):
    store, labels = several
    key, other = list(labels)[:2]
    rows = pd.read_csv(store.folder / other / "rows.csv")
    rows.loc[rows["metric"] == "size_bytes.total", "value"] = float("nan")
    rows.to_csv(store.folder / other / "rows.csv", index=False)
    rewrite(store, other, scene={"digest": "of another scene"})
    page = write_page(store, [key, other], tmp_path / "page")
    text = page.read_text()
    assert "## Quality against time" in text
    assert "## Quality against memory" not in text
    assert len(linked(page)) == 2 + 2 * 3
    assert "**" not in text


def test_numbers_of_a_setting_without_a_score_have_no_plot():
    lines = Lines([Repeated("", [])] * 3, {"method": ["ngp"] * 3, "steps": ["1", "2", "3"]})
    assert not [*_ablations(lines)]


@pytest.mark.parametrize("of", ["rows", "rows_with_cold"])
def test_a_bar_per_run_is_as_long_as_its_stages_together(of, request, tmp_path, drawn):
    rows = request.getfixturevalue(of)
    inside = rows["metric"].replace("stage_ms.field", "stage_ms.field/march")
    other = rows.assign(metric=inside)[rows["metric"] != "stage_ms.other"]
    one, two = run_of(rows, "run 0"), run_of(other, "run 1")
    two = replace(two, record={**two.record, "parts": {"field": "field"}})  # with what is inside
    figures.stage_bars([one, two], tmp_path / "bars.png")
    (axes,) = drawn[0].axes
    field, rest = axes.containers
    assert [bar.get_width() for bar in field] == [150.0, 150.0]
    assert [bar.get_width() for bar in rest] == [50.0, 0.0]
    assert [bar.get_x() for bar in rest] == [150.0, 150.0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["run 0", "run 1"]
