"""Experiments report the error they made and its order; methods take turns on the same frames."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bench.accuracy import (
    Experiment,
    Trial,
    _costs,
    best_instead,
    cheapest_within,
    experiment_rows,
    render_in_turns,
    steady_frames,
)
from bench.clock import FrameRecord
from bench.errors import SteerbenchError
from bench.protocol import EvaluationProtocol
from bench.trajectories import Step, Trajectory, from_split
from bench.types import Frame, composite

QUICK = EvaluationProtocol(name="quick", lpips=())


def power(step: float, order: float) -> Trial:
    """Wrong by 3 step^order in one of two numbers, by less in the other."""
    answer = torch.tensor([1 - 3 * step**order, 2.0], dtype=torch.float64)
    return Trial(step, lambda: answer, torch.tensor([1.0, 2.0], dtype=torch.float64))


@pytest.mark.parametrize("order", [0.5, 3.0])
def test_an_experiment_has_a_row_a_setting_with_its_largest_error_and_its_order(order, quiet_log):
    steps = [0.5, 0.25, 0.125, 0.0625]
    wrong = Trial(1.0, lambda: torch.zeros(2), 1e6 * torch.ones(2).double())
    trials = [wrong, *(power(step, order) for step in steps)]
    experiment = Experiment("power", "step", trials, (0.1, 0.3))  # the first, wrong, counts not
    rows = experiment_rows([experiment], 3, quiet_log)
    assert [row["setting"] for row in rows] == [1.0, *steps]
    errors = [1e6, *(3 * step**order for step in steps)]
    assert [row["error"] for row in rows] == pytest.approx(errors)
    for row in rows:
        assert row["order"] == pytest.approx(order, rel=1e-12)
        assert (row["order_from"], row["order_to"]) == (0.1, 0.3)
        assert 0 <= row["ms_lo"] <= row["ms"] <= row["ms_hi"]
    # Settings in words have no order.
    trial = Trial("packed", lambda: torch.ones(1), torch.zeros(1, dtype=torch.float64))
    (row,) = experiment_rows([Experiment("table", "format", [trial])], 1, quiet_log)
    assert (row["setting"], row["error"], row["order"]) == ("packed", 1.0, None)


class Brighter:
    """Renders the ground truth brighter by some 8-bit levels, and notes its turn in `turns`."""

    def __init__(self, scene, levels: float, turns: list, memory: int = 0) -> None:
        self.name, self.levels, self.turns, self.memory = "brighter", levels, turns, memory
        self.split, self.background = scene.splits["test"], scene.background

    def reset(self) -> None:
        self.turns.append((self.levels, "reset"))

    def render(self, camera, probe) -> Frame:
        number = next(n for n, known in enumerate(self.split.cameras) if known is camera)
        self.turns.append((self.levels, number))
        dark = composite(self.split.images[number], self.background) / 2
        picture = dark + self.levels / 255
        return Frame(picture, torch.ones_like(picture[..., 0]), torch.ones_like(picture[..., 0]))

    def settings(self) -> dict[str, str]:
        return {"device": "cpu"}


@pytest.fixture
def in_turns(tiny_scene, quiet_log):
    """Render the test split with methods of these brightnesses; rows, and who had which turn."""

    def rendered(*levels: float, memory: int = 0, repeats: int = 2, trajectory=None):
        turns: list = []
        methods = {str(n): Brighter(tiny_scene, n, turns, memory) for n in levels}
        path = trajectory or from_split(tiny_scene)
        return render_in_turns(methods, tiny_scene, path, QUICK, repeats, quiet_log), turns

    return rendered


def test_methods_take_turns_and_are_held_against_the_first_and_the_truth(in_turns, tiny_scene):
    rows, turns = in_turns(0, 8)
    count = len(tiny_scene.splits["test"])
    round_ = [(levels, turn) for turn in ("reset", *range(count)) for levels in (0, 8)]
    assert turns == 3 * round_  # one that warms up, two that are timed
    assert [row["setting"] for row in rows] == ["0", "8"]
    assert rows[0]["psnr_to_first"] == math.inf
    # Halves of odd levels round to even ones: by up to one level more or less than 8.
    assert -20 * math.log10(9 / 255) <= rows[1]["psnr_to_first"] <= -20 * math.log10(7 / 255)
    assert rows[1]["psnr"] > rows[0]["psnr"]  # half the truth is too dark
    assert rows[0]["worst"] == 0
    assert 7 / 255 - 1e-6 <= rows[1]["worst"] <= 9 / 255 + 1e-6
    for row in rows:
        assert 0 < row["ms_lo"] <= row["ms"] <= row["ms_hi"]


def frame(field: float, network: float | None = None, rays: int = 0) -> FrameRecord:
    """A frame of so many ms in two stages; without the second where it is None."""
    stages = {"field": field} if network is None else {"field": field, "network": network}
    return FrameRecord({name: int(ms * 1e6) for name, ms in stages.items()}, {"rays": rays}, {})


def test_the_costs_are_those_of_the_median_round_without_the_first_and_what_is_not_ready():
    cold, warming = frame(1000.0), [frame(500.0)] * 3
    slow = [cold, frame(40.0), frame(60.0)]
    usual = [cold, frame(10.0, 4.0, rays=6), frame(14.0, rays=8)]
    fast = [cold, frame(8.0), frame(8.0)]
    costs = _costs([*warming, *slow, *usual, *fast], [False, True, True])
    assert costs["ms"] == 14.0  # of (10 + 4 + 14) / 2
    assert (costs["ms_lo"], costs["ms_hi"]) == (8.0, 50.0)
    assert costs["stage_ms.field"] == 12.0
    assert costs["stage_ms.network"] == 2.0  # one of the two frames has none
    assert costs["work.rays"] == 7.0
    assert costs["p99_to_p50"] == 1.0  # both took 14
    assert _costs([frame(9.0), frame(3.0), frame(5.0)], [True])["ms"] == 3.0  # the lower of two


def test_frames_without_a_ground_truth_are_timed_and_not_scored(in_turns, tiny_scene):
    cameras = tiny_scene.splits["test"].cameras
    between = Trajectory("between", "test", (Step(cameras[0], 0), Step(cameras[1], None)))
    alone = Trajectory("alone", "test", (Step(cameras[0], 0),))
    (row,), _ = in_turns(0, trajectory=between)
    (known,), _ = in_turns(0, trajectory=alone)
    assert row["psnr"] == known["psnr"]
    assert steady_frames([Brighter(tiny_scene, 0, [])], between) == ([True, True], [0])


def test_a_frame_soon_after_a_cut_is_not_scored(in_turns, tiny_scene):
    path = from_split(tiny_scene)
    cut = replace(path, steps=(*path.steps[:2], replace(path.steps[2], cut=True)))
    rows, _ = in_turns(0, memory=1, trajectory=cut)
    whole, _ = in_turns(0, memory=1, trajectory=replace(path, steps=path.steps[:2]))
    assert rows[0]["psnr"] == whole[0]["psnr"]
    with pytest.raises(SteerbenchError, match="give more frames"):
        in_turns(0, memory=len(tiny_scene.splits["test"]))


def test_a_picture_with_a_nan_ends_it_and_is_no_setting(in_turns):
    with pytest.raises(SteerbenchError, match=r"nan rendered .* pixels of frame 0 as NaN"):
        in_turns(math.nan)


# Few values, so that there are ties.
POINTS = st.lists(st.tuples(st.integers(1, 6), st.integers(-3, 3)), min_size=1, max_size=30)


@given(POINTS)
def test_the_least_error_that_costs_no_more_stands_for_a_setting_and_for_itself(points):
    best = best_instead(*zip(*points, strict=True))
    for (cost, _), instead in zip(points, best, strict=True):
        affordable = [other for other in points if other[0] <= cost]
        assert points[instead] == min(affordable, key=lambda point: (point[1], point[0]))
        assert best[instead] == instead == points.index(points[instead])


@given(POINTS, st.integers(-4, 4))
def test_the_cheapest_within_a_limit_is_the_cheapest_of_those_allowed(points, limit):
    index = cheapest_within(*zip(*points, strict=True), limit)
    allowed = [point for point in points if point[1] <= limit]
    if not allowed:
        assert index is None
    else:
        assert points[index] == min(allowed)
