"""Types that signatures all over the project share, by what they mean."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

Say = Callable[[str], object]  # gets lines of text, for a user

Words = Sequence[str]  # of a command
Names = Sequence[str]

Named = Mapping[str, Any]  # values of any type by name, such as settings or facts
Values = dict[str, Any]  # such values, made here
Row = dict[str, Any]  # of a table, by column
Rows = list[Row]
Numbers = dict[str, float]  # by name
Sizes = dict[str, int]  # bytes by component
Texts = dict[str, str]  # by name
Labels = Mapping[str, str]  # given texts by name
Choices = dict[str, list[str]]  # values by setting
Json = Mapping[str, object]  # what JSON can hold, such as what a key is made of

AnyPath = str | Path

Size = tuple[int, int]  # width and height in pixels
