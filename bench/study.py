"""What a method says of itself to the studies that vary it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Variant:
    """A variant of a run by its `name`, and the `settings`, as of `steerbench run`, that make it."""

    name: str
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Axis:
    """A setting whose cost grows with its value.

    Attributes:
        label: of the value, "K = {}".
        setting: "method.model.channels".
        values: as they are given.
        size: of each value, in the unit that the cost is fitted over; None: the value itself.
    """

    label: str
    setting: str
    values: tuple[int, ...]
    size: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Study:
    """What can be varied of a method, and what its stages are. All of it may be left out.

    Attributes:
        knobs: by the name of a knob, what it may be turned to after the training.
        trained: the same for what asks for a training of its own.
        exact: the settings with which the trained model loses nothing to speed.
        skips: by what is not computed, the setting that switches it off with `false`.
        savings: what may be saved beyond `skips`, one after the other.
        axes: by name, what the cost of a frame grows with, beside pixels and threads.
        parts: the part of a frame that a stage is, with all within it that is no part of its own;
            a stage that is missing is a part under its own name.
        beside: by name, the settings of other methods that it is to be compared with.
    """

    knobs: Mapping[str, Sequence[Variant]] = field(default_factory=dict)
    trained: Mapping[str, Sequence[Variant]] = field(default_factory=dict)
    exact: tuple[str, ...] = ()
    skips: Mapping[str, str] = field(default_factory=dict)
    savings: Sequence[Variant] = ()
    axes: Mapping[str, Axis] = field(default_factory=dict)
    parts: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def study_of(method: Any) -> Study:
    """What the class (or function) of a method says of itself; of one that says nothing, nothing."""
    return getattr(method, "study", Study())
