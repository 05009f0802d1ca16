"""Types of settings that say which values are allowed, and the base of dataclasses that refuse
others."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, get_args, get_type_hints

from methods.kernels.types import expect


@dataclass(frozen=True)
class Only:
    """What a setting has to be: in words, and whether a value is it. None, where allowed, always
    is."""

    expected: str
    holds: Callable[[Any], bool]

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError with the `name` of a setting unless its `value` is it."""
        expect(value is None or self.holds(value), name, self.expected, value)


def between(least: int, most: int) -> Only:
    """A whole number in a range."""
    return Only(f"{least} to {most}", lambda x: least <= x <= most)


def multiple(step: int, most: int) -> Only:
    """A multiple of `step`, more than 0."""
    return Only(f"a multiple of {step} up to {most}", lambda x: 0 < x <= most and not x % step)


class Checked:
    """Base of dataclasses of settings: those whose types are `Annotated` with `Only` are checked.
    Errors put `prefix` before their names."""

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            for part in (hint, *get_args(hint)):  # of a type, or of one or None
                for only in getattr(part, "__metadata__", ()):
                    only.check(self.prefix + name, getattr(self, name))


TRANSMITTANCE = Only("a transmittance of 0 or more and less than 1", lambda x: 0 <= x < 1)
"""From 1 on, rays would end before they begin."""

Stop = Annotated[float, TRANSMITTANCE]
Positive = Annotated[float, Only("more than 0", lambda x: x > 0)]
NotNegative = Annotated[float, Only("0 or more", lambda x: x >= 0)]
Length = Annotated[float, Only("a length of more than 0", lambda x: x > 0)]
Share = Annotated[float, Only("a share in [0, 1]", lambda x: 0 <= x <= 1)]
SomeShare = Annotated[float, Only("a share in (0, 1]", lambda x: 0 < x <= 1)]
Fraction = Annotated[float, Only("0 or more and less than 1", lambda x: 0 <= x < 1)]
Count = Annotated[int, Only("1 or more", lambda x: x >= 1)]
Degree = Annotated[int, between(0, 3)]
Steps = Annotated[int | None, Only("1 or more, or none", lambda x: x >= 1)]
