"""Ranges of 8-bit activations that no frame has given: those of `trtexec --int8` without `--calib`.

`setTensorDynamicRange` in samples/common/sampleEngines.cpp of the repository NVIDIA/TensorRT (at
147005ff) goes through the layers in order. An input that has no range yet gets [-2, 2], an output
[-4, 4], the output of a pooling layer [-2, 2]. So the inputs of a network and what is pooled have
[-2, 2], all else [-4, 4]. An 8-bit integer q, from -128 to 127, stands for q * largest / 127.

Only the inputs of products are rounded. TensorRT fuses sums and activations with the convolution
before them, and leaves the outputs of a network in float32.
"""

from __future__ import annotations

INPUT, OUTPUT = 2.0, 4.0


def largest(maker: str | None) -> float:
    """The largest number in the range of a tensor.

    Args:
        maker: type of the operator that computes the tensor, None for an input of the network.
    """
    return INPUT if maker is None or maker.endswith("Pool") else OUTPUT
