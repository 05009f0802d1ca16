"""The engine that is chosen: the fastest whose pictures are as good, once and for all."""

import math
from collections.abc import Sequence

import pytest
import torch

from bench.errors import SteerbenchError, Unavailable
from methods.engines import Engine, auto
from methods.engines.auto import Auto, EngineFigures

CPU = torch.device("cpu")


class Exact(Engine):
    name, precisions = "exact", ("fp32", "bf16")

    def build(self, *given):
        raise NotImplementedError


class Quick(Exact):
    name, precisions = "quick", ("fp32", "int8")


class Elsewhere(Exact):
    name, precisions = "elsewhere", ("fp32",)

    def check(self, device: torch.device) -> None:
        raise Unavailable("not here")


FIGURES = {
    "exact, fp32": EngineFigures(30.0, 9.0),
    "exact, bf16": EngineFigures(29.96, 8.0),
    "quick, fp32": EngineFigures(30.1, 10.0),
    "quick, int8": EngineFigures(29.94, 2.0),
}


@pytest.fixture(autouse=True)
def kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(auto, "KINDS", (Exact, Elsewhere, Quick))


def measured(engines: Sequence[Engine]) -> list[EngineFigures]:
    return [FIGURES[str(engine)] for engine in engines]


@pytest.mark.parametrize(
    ("loss", "chosen"), [(0.0, "exact, fp32"), (0.05, "exact, bf16"), (0.07, "quick, int8")]
)
def test_the_fastest_is_chosen_whose_pictures_lose_no_more_than_they_may(
    loss, chosen, tmp_path, quiet_log
):
    assert str(Auto(loss).chosen(CPU, measured, tmp_path, quiet_log)) == chosen


def test_what_was_measured_is_remembered(tmp_path, quiet_log):
    first = Auto(0.07).chosen(CPU, measured, tmp_path, quiet_log)
    again = Auto(0.07).chosen(CPU, lambda engines: pytest.fail("again"), tmp_path, quiet_log)
    assert str(again) == str(first)


@pytest.mark.parametrize("psnr", [math.nan, -math.inf])
def test_pictures_that_are_not_finite_are_an_error_and_not_remembered(psnr, tmp_path, quiet_log):
    def broken(engines: Sequence[Engine]) -> list[EngineFigures]:
        return [EngineFigures(psnr, 9.0) for _ in engines]

    with pytest.raises(SteerbenchError, match=r"finite pictures .* renders others with exact, fp"):
        Auto(0.05).chosen(CPU, broken, tmp_path, quiet_log)
    assert str(Auto(0.07).chosen(CPU, measured, tmp_path, quiet_log)) == "quick, int8"


def test_a_choice_depends_on_what_there_is_to_choose_from(monkeypatch):
    before = Auto(0.05).key(CPU)
    assert Auto(0.05).key(CPU) == before
    monkeypatch.setattr(auto, "KINDS", (Exact,))
    assert Auto(0.05).key(CPU) != before
