"""What a method declares for the studies that vary it: its knobs, switches, axes and parts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Variant:
    """A variant of a run: its `name`, and the `settings` that make it, as of `steerbench run`."""

    name: str
    settings: tuple[str, ...] = ()


def turned(label: str, setting: str, values: Iterable[object], *more: str) -> list[Variant]:
    """A variant for each of the `values` of a setting; all have `more` settings."""
    return [Variant(f"{label} {value}", (f"{setting}={value}", *more)) for value in values]


@dataclass(frozen=True)
class Axis:
    """A setting whose value the cost of a frame grows with.

    Attributes:
        label: how a value is shown, "K = {}".
        setting: its name, "method.model.channels".
        values: the values that are measured.
        size: what each value amounts to, for the fit of a power; None: the value itself.
    """

    label: str
    setting: str
    values: tuple[int, ...]
    size: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Study:
    """What can be varied of a method, and what its stages are; each attribute may be left out.

    Attributes:
        knobs: by name, the settings a knob can have after the training. Engines and precisions
            need not be declared.
        trained: the same for settings that need a training of their own.
        exact: the settings with which the trained model trades no error for speed.
        skips: by what is skipped, the setting that switches this off with `false`.
        skips_with: settings that all lines of the study of skips share.
        savings: further savings, each compared on top of all skips.
        axes: by name, what the cost of a frame grows with, beside pixels and threads.
        parts: the part of a frame that a stage, with all stages inside it, is counted in; other
            stages are parts of their own.
        network_stage: the stage that the engine computes.
        network_size: the name of the network in `Method.sizes`.
        beside: by name, the settings of other methods to compare with.
    """

    knobs: Mapping[str, Sequence[Variant]] = field(default_factory=dict)
    trained: Mapping[str, Sequence[Variant]] = field(default_factory=dict)
    exact: tuple[str, ...] = ()
    skips: Mapping[str, str] = field(default_factory=dict)
    skips_with: tuple[str, ...] = ()
    savings: Sequence[Variant] = ()
    axes: Mapping[str, Axis] = field(default_factory=dict)
    parts: Mapping[str, str] = field(default_factory=dict)
    network_stage: str = ""
    network_size: str = ""
    beside: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def part_of(self, stage: str) -> str:
        """The part of a frame that `stage`, "field/march", is counted in."""
        outer = stage
        while outer and outer not in self.parts:
            outer = outer.rpartition("/")[0]
        return self.parts.get(outer, stage)


def study_of(method: Any) -> Study:
    """What the class, function or object of a method declares as `study`; an empty one if none."""
    return getattr(method, "study", Study())
