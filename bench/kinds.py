"""Types that signatures all over the project share, by what they mean."""

from collections.abc import Callable, Sequence
from typing import Any

Say = Callable[[str], object]  # gets lines of text, for a user

Words = Sequence[str]  # of a command

Row = dict[str, Any]  # of a table, by column
Rows = list[Row]


Size = tuple[int, int]  # width and height in pixels
