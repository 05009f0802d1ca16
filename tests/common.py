"""What tests of all packages say in the same words."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.errors import SteerbenchError

ROOT = Path(__file__).parents[1]
"""Of the checkout."""

assert_near = partial(torch.testing.assert_close, rtol=0)
"""Within `atol`, however large the numbers are."""


def seeded(seed: int) -> torch.Generator:
    """Random numbers of the CPU, the same each time."""
    return torch.Generator().manual_seed(seed)


def refusal(message: str, kind: type[Exception] = SteerbenchError) -> pytest.RaisesExc[Exception]:
    """In here something is refused with an error that says `message`, a pattern."""
    return pytest.raises(kind, match=message)


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


def write_json(path: Path, record: Any) -> None:
    path.write_text(json.dumps(record))
