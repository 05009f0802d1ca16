"""Ranges of 8-bit activations without calibration: those of `trtexec --int8` without `--calib`.

`setTensorDynamicRange` in samples/common/sampleEngines.cpp of the repository NVIDIA/TensorRT (at
147005ff) goes through the layers in order. An input without a range gets [-2, 2], an output
[-4, 4], the output of a pooling layer [-2, 2]. So network inputs and pooled tensors have [-2, 2],
all others [-4, 4]. An 8-bit integer q, from -128 to 127, stands for q * largest / 127.

Only the inputs of products are rounded: TensorRT fuses sums and activations with the convolution
before them, and leaves the network's outputs in float32.
"""

from __future__ import annotations

INPUT, OUTPUT = 2.0, 4.0


def largest(maker: str | None) -> float:
    """The largest number in the range of a tensor.

    Args:
        maker: type of the operator that computes the tensor; None for an input of the network.
    """
    return INPUT if maker is None or maker.endswith("Pool") else OUTPUT
