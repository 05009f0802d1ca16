"""Every wait for the GPU has its line."""

import linecache
import warnings

import pytest
import torch

from bench.waits import device_waits


def test_the_line_that_waits_or_calls_what_waits_in_torch_is_named(gpu):
    x = torch.ones(3, device="cuda")
    with device_waits() as waits:
        for _ in range(2):
            torch.unique(x)
    ((line, count),) = waits.items()
    assert (line.path, count) == (__file__, 2)
    assert linecache.getline(*line).strip() == "torch.unique(x)"
    scope = {}
    text = "def wait():\n import warnings\n warnings.warn('called a synchronizing CUDA operation')"
    exec(compile(text, torch.functional.__file__, "exec"), scope)
    with device_waits() as waits:
        scope["wait"]()
    ((line, count),) = waits.items()
    assert (line.path, count) == (__file__, 1)


def test_a_wait_in_a_backward_pass_is_that_of_its_line(gpu):
    class Asking(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, grad):
            return grad * grad.max().item()

    x = torch.ones(3, device="cuda", requires_grad=True)
    y = Asking.apply(x).sum()
    with device_waits() as waits:
        y.backward()
    ((line, count),) = waits.items()
    assert (line.number, count) == (Asking.backward.__code__.co_firstlineno + 2, 1)


def test_other_warnings_are_shown_as_ever_and_afterwards_none_is_counted(gpu):
    with pytest.warns(UserWarning, match="of something else"), device_waits() as waits:
        warnings.warn("of something else", stacklevel=1)
    torch.ones(1, device="cuda").item()
    assert not waits
    assert torch.cuda.get_sync_debug_mode() == 0
