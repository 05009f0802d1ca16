"""Claims: the gap in the paper and here, its interval, and what may be concluded from them."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from bench.rows import half_interval, path_interval
from reports.claims import (
    AGREES,
    AS,
    AT_MOST,
    BY_ONE,
    LARGER,
    NOT_MEASURED,
    OPEN,
    OPPOSITE,
    SMALLER,
    UNKNOWN,
    Claim,
    Comparison,
    Gap,
    apart,
    claim_table,
    compare,
    finding_table,
    gap,
    told,
)
from reports.runs import Repeated, Run
from reports.tables import ABSENT
from tests.reports.conftest import changed, elsewhere, of_scene, shifted

RISING = Claim("psnr", ["one", "two"], 0.1)
ALIKE = replace(RISING, alike=True)


def between(one: list[Run], two: list[Run], metric: str = "psnr") -> Gap:
    return gap(metric, Repeated("one", one), Repeated("two", two))


def comparison(claim: Claim, by: float, half: float, paper: float, proves=True) -> Comparison:
    return Comparison(claim, "one", "two", paper, Gap(by, half, "3 seeds", proves), "Table 9")


@pytest.mark.parametrize(
    ("by", "half", "paper", "verdict"),
    [
        (0.9, 0.3, 1.0, AS),
        (0.55, 0.35, 1.0, AS),  # at most 0.90: the margin is 0.10
        (0.5, 0.35, 1.0, SMALLER),
        (10.0, 0.25, 1.19, LARGER),
        (2.0, 1.5, 1.0, AGREES),  # from 0.5 to 3.5: no size can be told
        (0.12, 0.1, 0.05, AS),  # or none but that it is small
        (0.5, 0.5, 1.0, OPEN),  # up to 1.0, as in the paper
        (0.3, 0.5, 1.0, AT_MOST),
        (-0.1, 0.2, 1.0, AT_MOST),
        (-0.5, 0.4, 1.0, OPPOSITE),
        (0.0, 0.0, 1.0, AT_MOST),
        (0.5, 0.4, math.nan, AGREES),
        (-0.1, 0.2, math.nan, OPEN),
        (-0.5, 0.4, math.nan, OPPOSITE),
        (0.5, math.nan, 1.0, OPEN),
        (math.nan, math.nan, 1.0, UNKNOWN),  # a figure is missing
    ],
)
def test_a_verdict_tells_sign_and_size_of_the_whole_interval(by, half, paper, verdict):
    assert comparison(RISING, by, half, paper).verdict == verdict
    ratio = replace(RISING, metric="frame_ms", margin=math.exp(0.1))
    assert comparison(ratio, by, half, paper).verdict == verdict  # of logarithms


@pytest.mark.parametrize(
    ("by", "half", "verdict"),
    [
        (0.02, 0.08, AS),
        (0.05, 0.06, OPEN),
        (0.2, 0.05, LARGER),
        (-0.2, 0.05, AS),  # hardly any loss holds of a gain
        (0.0, math.nan, OPEN),
    ],
)
def test_lines_are_alike_if_the_second_is_not_above_the_first_by_more_than_the_margin(
    by, half, verdict
):
    assert comparison(ALIKE, by, half, 0.02).verdict == verdict


def test_a_verdict_by_one_seed_says_so_unless_nothing_can_be_told():
    assert comparison(RISING, 0.9, 0.3, 1.0, proves=False).verdict == AS + BY_ONE
    assert comparison(RISING, 0.9, 2.0, 1.0, proves=False).verdict == OPEN


@pytest.mark.parametrize("apart", [[0.9, 1.0, 1.1, 0.9, 1.0, 1.1], [1, -1, 1, -1, 1, -0.9]])
def test_one_run_of_each_line_is_compared_frame_by_frame(run, apart):
    found = between([run], [shifted(run, apart)])
    assert (found.over, found.proves) == ("6 frames of one seed", False)
    assert found.by == pytest.approx(np.mean(apart))
    assert found.half == pytest.approx(path_interval(np.array(apart)))


def test_the_gap_of_one_seed_is_that_of_the_figures_shown(run):
    """Which may be over fewer frames: those that all lines of a table have."""
    shown = changed(shifted(run, 0.3), {"psnr": run.values["psnr"] + 1.0})
    assert between([run], [shown]).by == pytest.approx(1.0)


def with_times(run: Run, ms: np.ndarray) -> Run:
    frames = run.frames.assign(frame_ms=ms)
    return replace(changed(run, {"frame_ms": ms.mean()}), read_frames=lambda: frames)


def test_the_ratio_of_times_has_the_interval_of_its_frames(run):
    """Frames that are all twice as slow leave no doubt; others as much as their shares differ."""
    ms = np.array([10.0, 12.0, 9.0, 11.0, 13.0, 10.0])
    found = between([with_times(run, ms)], [with_times(run, 2 * ms)], "frame_ms")
    assert (found.by, found.half) == (pytest.approx(math.log(2)), pytest.approx(0))
    noise = 1 + 0.01 * np.array([1, -1, 2, 0, -1, -1])
    found = between([with_times(run, np.full(6, 10.0))], [with_times(run, 10 * noise)], "frame_ms")
    assert found.half == pytest.approx(path_interval(noise / noise.mean()))


@pytest.mark.parametrize(
    ("scenes", "seeds", "over"),
    [("a", 3, "3 seeds"), ("abc", 1, "3 scenes"), ("ab", 2, "2 scenes × 2 seeds")],
)
def test_a_pair_has_the_same_scene_and_seed_and_several_scenes_are_the_samples(
    run, scenes, seeds, over
):
    """Scenes and seeds differ by decibels, the lines by about a tenth with each of them."""
    places = [(scene, seed) for scene in scenes for seed in range(seeds)]
    by = {place: 0.1 + 0.01 * number for number, place in enumerate(places)}
    one = [of_scene(run, x, 3.0 * n, seed=seed) for n, (x, seed) in enumerate(places)]
    two = [of_scene(run, x, 3.0 * n + by[x, seed], seed=seed) for n, (x, seed) in enumerate(places)]
    found = between(one, two[::-1])
    assert (found.over, found.proves) == (over, True)
    assert found.by == pytest.approx(np.mean([*by.values()]))
    of_scenes = [[by[x, seed] for seed in range(seeds)] for x in scenes]
    samples = np.mean(of_scenes, axis=1) if len(scenes) > 1 else np.array(of_scenes[0])
    assert found.half == pytest.approx(half_interval(samples))
    alone = between(one, two[:1])  # of a pair, frames are compared
    assert (alone.over, alone.by) == ("6 frames of one seed", pytest.approx(0.1))


def test_a_figure_without_frames_alone_tells_nothing_but_bytes_are_computed(run):
    larger = changed(run, {"size_bytes.total": 2 * run.values["size_bytes.total"]})
    assert math.isnan(between([run], [larger], "fps").half)
    assert between([run], [larger], "size_bytes.total") == Gap(
        pytest.approx(math.log(2)), 0.0, "computed, not sampled", True
    )


def test_a_stage_includes_the_stages_inside_it(run):
    """The look-up has an inner stage; it takes as long as both."""
    whole = run.values["stage_ms.look-up"] + run.values["stage_ms.look-up/add"]
    slower = changed(run, {"stage_ms.look-up": run.values["stage_ms.look-up"] + whole})
    found = between([run], [slower], "stage_ms.look-up")
    assert found.by == pytest.approx(math.log(2))
    assert found.half == 0  # the frames are the same


def beside(run: Run, *keys: str) -> Run:
    """`run` as one of those with these keys that were measured in turns."""
    made_of = {**run.record["made_of"], "beside": [*keys]}
    return replace(run, record={**run.record, "made_of": made_of})


@pytest.mark.parametrize("other", [elsewhere, lambda run: beside(run, "a", "b")])
def test_times_of_another_machine_or_of_other_turns_are_not_compared(run, other):
    assert between([run], [other(run)], "frame_ms") is NOT_MEASURED
    assert between([run], [other(run)]) is not NOT_MEASURED
    assert between([run], []) is NOT_MEASURED
    assert between([beside(run, "a")], [beside(run, "a")], "frame_ms") is not NOT_MEASURED


def test_one_perfect_frame_does_not_make_two_lines_alike(run):
    """It makes the mean PSNR of both infinite."""
    psnr = run.frames["psnr"].to_numpy()
    perfect = np.where(np.arange(6) == 0, math.inf, psnr)
    one, two = (
        replace(changed(run, {"psnr": math.inf}), read_frames=lambda x=x: run.frames.assign(psnr=x))
        for x in (perfect, perfect + 3)
    )
    assert between([one], [two]).by == pytest.approx(3 * 5 / 6)
    both = between([one, changed(one, {}, seed=1)], [two, changed(two, {}, seed=1)])
    assert both.by == pytest.approx(3 * 5 / 6)


def compared(
    run: Run, published: Mapping[str, float], measured: Mapping[str, float], claim: Claim = RISING
) -> list[Comparison]:
    lines = {label: Repeated(label, [shifted(run, by)]) for label, by in measured.items()}
    return list(compare(replace(claim, lines=["one", "two", "three"]), lines, published))


def test_neighbours_are_compared_if_both_were_measured_and_the_paper_gives_both_or_none(run):
    all_three = {"one": 0.0, "two": 1.0, "three": 3.0}
    both = compared(run, {"one": 31.0, "two": 31.5, "three": 33.0}, all_three)
    assert [(x.smaller, x.larger) for x in both] == [("one", "two"), ("two", "three")]
    assert [x.paper for x in both] == pytest.approx([0.5, 1.5])
    assert [x.here.by for x in both] == pytest.approx([1.0, 2.0])
    assert len(compared(run, {"one": 31.0, "two": 31.5}, all_three)) == 1
    unknown = compared(run, {}, all_three)
    assert len(unknown) == 2
    assert all(math.isnan(x.paper) for x in unknown)
    assert compared(run, {}, {"one": 0.0, "three": 1.0}) == []


def test_only_growth_is_turned_round_where_the_paper_has_the_opposite_order(run):
    """That three preceding frames gain no more than two stays a claim about the third."""
    both = {"one": 31.04, "two": 31.0}, {"one": 0.0, "two": 0.3}
    claims = (replace(claim, says="gain of two") for claim in (RISING, ALIKE))
    (turned,), (alike,) = (compared(run, *both, claim) for claim in claims)
    assert (turned.smaller, turned.larger) == ("two", "one")
    assert (turned.paper, turned.here.by) == (pytest.approx(0.04), pytest.approx(-0.3))
    assert (alike.smaller, alike.paper) == ("one", pytest.approx(-0.04))
    assert (turned.claim.says, alike.claim.says) == ("", "gain of two")
    assert alike.verdict == LARGER + BY_ONE


def test_gaps_are_differences_or_ratios_and_unknown_ones_are_absent():
    assert told("psnr", apart("psnr", 31.0, 31.61)) == "+0.61"
    assert told("psnr", apart("psnr", 31.0, 30.0)) == "-1.00"
    assert told("frame_ms", apart("frame_ms", 13.3, 16.625)) == "×1.25"
    assert told("fps", apart("fps", 60.0, 0.02)) == "×0.00033"
    assert told("size_bytes.total", apart("size_bytes.total", 29.4e6, 1930e6)) == "×65.6"
    assert told("stage_ms.field", apart("stage_ms.field", 0.0, 0.11)) == ABSENT
    assert told("psnr", apart("psnr", 31.0, math.nan)) == ABSENT
    assert apart("psnr", math.inf, math.inf) == 0.0


def test_a_line_of_the_table_has_no_more_than_two_numbers_in_a_cell():
    size = replace(RISING, metric="size_bytes.total", margin=1.1)
    found = [
        comparison(RISING, -0.48, 0.15, 0.61),
        comparison(ALIKE, 0.02, 0.05, 0.04),
        comparison(size, math.log(2), 0.0, math.log(3.6)),
    ]
    over = "3 seeds"
    assert claim_table(found).lines == (
        ("Table 9, PSNR, dB: one < two", "+0.61", "-0.48", "-0.63 – -0.33", over, "0.1", OPPOSITE),
        ("Table 9, PSNR, dB: one ≈ two", "+0.04", "+0.02", "-0.03 – +0.07", over, "0.1", AS),
        ("Table 9, model, MB: one < two", "×3.60", "×2.00", "", over, "×1.1", SMALLER),
    )


def test_a_finding_on_a_further_data_set_has_a_line_where_its_figures_differ():
    told = replace(RISING, says="PSNR gained", main=True)
    first = replace(comparison(told, 0.9, 0.3, 1.0), table="Table 9")
    same = replace(first, data_set="Tanks & Temples")
    other = replace(comparison(told, 0.2, 0.1, 1.0), data_set="Tanks & Temples")
    silent = comparison(RISING, 0.9, 0.3, 1.0)
    assert [line[0] for line in finding_table([first, same, silent]).lines] == [
        "**PSNR gained (dB)**"
    ]
    table = finding_table([first, other])
    assert [line[0] for line in table.lines] == [
        "**PSNR gained (dB)**",
        "**PSNR gained, Tanks & Temples (dB)**",
    ]
