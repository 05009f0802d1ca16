"""Variants on common ground: which can be used, and what is refused before anything is trained."""

from __future__ import annotations

import pytest

from bench.errors import SteerbenchError, Unavailable
from sweeps.variants import fitted
from tests.sweeps.conftest import HERE, QUICK

WORDS = [f"--config-dir={HERE / 'configs'}", *QUICK]
ABSENT = 0.9
"""The level of a grey that cannot be used."""


@pytest.fixture
def trained(elsewhere: None, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The levels of the greys that were fitted."""
    import stand_ins

    levels: list[float] = []
    make = stand_ins.Grey.__init__

    def made(self, seed: int, device: str, backend: str, level: float) -> None:
        if level == ABSENT:
            raise Unavailable("it is not installed")
        make(self, seed, device, backend, level)

    monkeypatch.setattr(stand_ins.Grey, "__init__", made)
    monkeypatch.setattr(stand_ins.Grey, "fit", lambda self, *_: levels.append(self.level))
    return levels


def greys(*levels: float, more: tuple[str, ...] = ()) -> dict[str, list[str]]:
    return {str(level): [*WORDS, f"method.level={level}", *more] for level in levels}


def test_what_cannot_be_used_is_left_out(trained):
    with fitted(greys(0.1, ABSENT, 0.3), 2) as (methods, _, _):
        assert list(methods) == ["0.1", "0.3"]
    assert trained == [0.1, 0.3]


def test_without_the_first_there_is_nothing_to_compare_with(trained):
    with pytest.raises(Unavailable), fitted(greys(ABSENT, 0.3), 2):
        pass


@pytest.mark.parametrize(
    ("memory", "more", "message"),
    [
        (2, (), "give more frames"),
        (0, ("+protocol.memory=cold", "protocol.name=cold"), r"protocol\.memory: expected steady"),
    ],
)
def test_what_cannot_be_compared_is_refused_at_once(trained, monkeypatch, memory, more, message):
    monkeypatch.setattr("stand_ins.Grey.memory", memory)
    with pytest.raises(SteerbenchError, match=message), fitted(greys(0.1, more=more), 2):
        pass
    assert trained == []


def test_pictures_too_small_for_lpips_are_not_refused_where_it_is_not_computed(trained):
    with fitted(greys(0.1, more=("protocol=steerbench-1",)), 1) as (_, ground, _):
        assert len(ground.trajectory.steps) == 1
        assert ground.protocol.lpips == ()
