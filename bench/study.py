"""What a method declares for the studies that vary it: its knobs, switches, axes and parts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Variant:
    """A variant of a run: its `name`, and the `settings` of `steerbench run` that make it."""

    name: str
    settings: Sequence[str] = ()


def turned(label: str, setting: str, values: Iterable[object], *more: str) -> list[Variant]:
    """One variant for each of the `values` of a setting; all share the settings in `more`."""
    return [Variant(f"{label} {value}", (f"{setting}={value}", *more)) for value in values]


@dataclass(frozen=True)
class Axis:
    """A setting that quality and cost of a frame grow with, and that needs a training a value."""

    label: str  # how a value is shown, "K = {}"
    setting: str  # its name, "method.model.channels"; of the logarithm of a size, "log2_..."
    values: tuple[int, ...]  # to measure

    def size(self, value: int) -> float:
        """What the cost is a power of."""
        return 2.0**value if self.setting.rpartition(".")[2].startswith("log2_") else value


@dataclass(frozen=True)
class Study:
    """What can be varied in a method, and which stages it has; every attribute is optional.

    The axes that tables of the paper vary (`sweeps/configs/experiment`) need not be declared.
    """

    # By knob, the variants that need no new training (engines and precisions need not be declared),
    # and those that need a training of their own.
    knobs: Mapping[str, Sequence[Variant]] = field(default_factory=dict)
    trained: Mapping[str, Sequence[Variant]] = field(default_factory=dict)
    exact: Sequence[str] = ()  # settings that give up no accuracy of the trained model for speed
    # By what is skipped, the setting that switches this skipping off with `false`; further savings,
    # each on top of all skips.
    skips: Mapping[str, str] = field(default_factory=dict)
    savings: Sequence[Variant] = ()
    axes: Mapping[str, Axis] = field(default_factory=dict)  # by name, beside pixels and threads
    # By stage, the part of a frame that it counts towards, with all stages nested in it; "network"
    # is the part that an engine computes. Other stages are parts of their own.
    parts: Mapping[str, str] = field(default_factory=dict)
    chosen: Sequence[str] = ()  # the method's own settings that no training depends on


def part_of(stage: str, parts: Mapping[str, str]) -> str:
    """The part of a frame that `stage` (for example "field/march") counts towards."""
    outer = stage
    while outer and outer not in parts:
        outer = outer.rpartition("/")[0]
    return parts.get(outer, stage)


def study_of(method: Any) -> Study:
    """The `study` attribute of a method's class, function or object; an empty one if missing, or if
    only the object knows it."""
    found = getattr(method, "study", None)
    return found if isinstance(found, Study) else Study()
