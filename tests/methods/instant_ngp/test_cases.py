"""The stress cases of the training."""

from __future__ import annotations

from typing import NoReturn

import pytest

from bench.types import Unavailable
from methods.instant_ngp.cases import cases
from methods.instant_ngp.field import HashField

TRAINING = [case for case in cases() if case.subject == "training"]


@pytest.mark.parametrize("case", TRAINING, ids=lambda case: case.name)
def test_what_is_not_there_is_no_answer(case, monkeypatch: pytest.MonkeyPatch) -> None:
    def density(*_: object) -> NoReturn:
        raise Unavailable("not on this machine")

    monkeypatch.setattr(HashField, "density", density)
    row = case.check(next(iter(case.tolerances)), "cpu")
    assert row["status"] == "unavailable: not on this machine"
