"""A small network without biases, for many samples: its activations do not leave the cache.

Such networks follow the encoding in Instant-NGP (Müller et al. 2022, Section 5.4), where they are
"fully fused" (Müller et al. 2021, Section 4.1).
"""

from torch import Tensor

from bench.types import SomeTensors, check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import expect


def mlp(inputs: SomeTensors, weights: SomeTensors, *, backend: str = "auto") -> Tensor:
    """The outputs W_n relu(... relu(W_1 x)) [S, O_n] of a network with a ReLU between its layers.

    Differentiable in inputs and weights; NaN stays NaN. `inputs` are one or two tensors [S, I]; x
    is both, side by side. `weights` are [O, I] of each layer, of the same dtype as the inputs, for
    backend "cpu" float32 or bfloat16.
    """
    expect(len(inputs) in (1, 2), "inputs", "one or two", len(inputs))
    expect(bool(weights), "weights", "one layer or more", "none")
    for part in inputs:
        check_shape("inputs", part, len(inputs[0]), None)
    channels = sum(part.shape[1] for part in inputs)
    for layer in weights:
        check_shape("weights", layer, None, channels)
        channels = len(layer)
    return implementation(__name__, backend, inputs[0].device).mlp(inputs, weights)
