"""Several runs in one table: a line each, the best in bold, and only among what is comparable."""

import math

import pytest

from reports.comparison import comparison, ranks, shown_as
from reports.lines import as_lines
from reports.runs import Repeated
from tests.common import refusal
from tests.reports.conftest import changed, elsewhere, run_of

FACTS = dict.fromkeys(("split", "trajectory", "budget", "protocol", "device"), "same")


@pytest.fixture
def make(rows):
    def make_run(label, rows=rows, digest="d", **figures):
        machine, scene = {"cpu": "EPYC", "threads": 2, "gpus": []}, {"digest": digest}
        run = run_of(rows.assign(**FACTS), label, machine=machine, scene=scene)
        return changed(run, figures)

    return make_run


def table_of(runs):
    return comparison(as_lines(runs), {})[0]


def bold(table) -> set[tuple[str, str]]:
    cells = ((line[0], *x) for line in table.lines for x in zip(table.columns, line, strict=True))
    return {(label, column) for label, column, text in cells if text.startswith("**")}


def test_every_run_has_a_line_with_quality_speed_size_and_training(make):
    table = table_of([make("ngp"), make("nerf", ssim=math.nan)])
    assert table.columns[1:4] == ("PSNR, dB ↑", "SSIM ↑", "LPIPS alex ↓")
    assert table.columns[4:] == ("ms / frame ↓", "FPS ↑", "model, MB ↓", "training, s ↓")
    assert table.lines[0] == ("ngp", "30.46", "0.9877", "n/a", "200.0", "5.00", "25.20", "61")
    assert table.lines[1][:3] == ("nerf", "30.46", "n/a")


def test_the_best_is_the_highest_or_the_lowest_as_the_arrow_says(make):
    table = table_of([make("slow", psnr=31.0, frame_ms=300.0), make("fast", psnr=29.0)])
    assert ("slow", "PSNR, dB ↑") in bold(table)
    assert ("fast", "ms / frame ↓") in bold(table)
    assert not {("fast", "PSNR, dB ↑"), ("slow", "ms / frame ↓")} & bold(table)
    assert "LPIPS alex ↓" not in {column for _, column in bold(table)}  # not available


def test_perfect_pictures_are_the_best(make):
    table = table_of([make("perfect", psnr=math.inf), make("good", psnr=30.0)])
    assert {label for label, column in bold(table) if "PSNR" in column} == {"perfect"}


def test_one_run_or_runs_of_different_kinds_have_no_best(make):
    other = changed(make("c"), {}, protocol="quick")
    runs = [make("a"), elsewhere(make("b")), other, make("d", digest="other")]
    assert bold(table_of(runs)) == set()


def test_cold_frames_have_a_table_of_their_own_and_compete_among_themselves(make, rows_with_cold):
    others = make("b", rows_with_cold), make("c", rows_with_cold, psnr=20.0)
    table, cold = comparison(as_lines([make("a"), *others]), {})
    shown = [("a", "**30.46**"), ("b", "**30.46**"), ("c", "20.00")]
    assert [line[:2] for line in table.lines] == shown
    assert [line[:2] for line in cold.lines] == [("b", "**27.46**"), ("c", "20.00")]
    assert cold.columns[-1] == "ms / frame ↓"
    assert cold.lines[0][-1] == "400.0"


def test_a_mean_shares_the_rank_of_a_better_one_within_their_intervals(make):
    def line(*psnr):
        return Repeated("", [changed(make("m", psnr=x), {}, seed=n) for n, x in enumerate(psnr)])

    best, close, far = line(31.0, 31.2), line(30.9, 31.25), line(20.0, 20.2)
    assert ranks([best, close, far], "psnr") == {0: 1, 1: 1}
    assert ranks([best, close], "psnr") == {}  # all alike
    paired = line(30.9, 31.1)  # 0.1 dB below the best with each seed
    assert ranks([best, paired, far], "psnr") == {0: 1, 1: 2}
    single = [line(31.1), line(31.0), line(20.0)]  # nothing is known of their spread
    assert ranks(single, "psnr") == {0: 1, 1: 2}


@pytest.mark.parametrize(
    ("metric", "label", "text"),
    [
        ("peak_bytes", "peak memory, MB ↓", "1.50"),
        ("size_bytes.table", "table, MB ↓", "1.50"),
        ("stage_ms.field", "field, ms ↓", "1500000.00"),
        ("work.samples", "samples, 1/frame ↓", "1500000"),
    ],
)
def test_a_figure_is_written_in_its_unit(metric, label, text):
    shown = shown_as(metric)
    assert (shown.heading, shown.write(1.5e6).replace(",", "")) == (label, text)


def test_a_metric_without_a_better_side_has_no_best(make, rows):
    renamed = rows.replace({"metric": {"ssim": "warp_1_true"}})
    lines = [Repeated(x, [make(x, renamed, warp_1_true=by)]) for x, by in (("a", 0.1), ("b", 0.2))]
    assert ranks(lines, "warp_1_true") == {}


def test_a_metric_that_does_not_exist_is_refused():
    with refusal("pnsr: no such metric; expected one as"):
        shown_as("pnsr")
