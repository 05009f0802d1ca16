"""Composites pictures with an opacity channel onto a background."""

from __future__ import annotations

from torch import Tensor


def composite(picture: Tensor, background: Tensor) -> Tensor:
    """Composite an 8-bit `picture` [H, W, 3 or 4] onto `background` [3]; float [H, W, 3]."""
    values = picture.float() / 255.0
    if values.shape[-1] == 3:
        return values
    rgb, alpha = values[..., :3], values[..., 3:]
    return rgb * alpha + background.to(values) * (1.0 - alpha)
