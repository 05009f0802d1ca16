"""What tests of all packages say in the same words."""

from functools import partial

import pytest
import torch

from bench.errors import SteerbenchError

assert_near = partial(torch.testing.assert_close, rtol=0)
"""Within `atol`, however large the numbers are."""


def seeded(seed: int) -> torch.Generator:
    """Random numbers of the CPU, the same each time."""
    return torch.Generator().manual_seed(seed)


def refusal(message: str) -> pytest.RaisesExc[SteerbenchError]:
    """In here something is refused with a SteerbenchError that says `message`, a pattern."""
    return pytest.raises(SteerbenchError, match=message)
