"""A camera as the pipeline sees it: at full and at low resolution."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bench.cameras import crop_camera, scale_camera
from bench.types import Camera


@dataclass(frozen=True)
class View:
    """A camera at both resolutions."""

    full: Camera  # its picture padded to multiples of s; its intrinsics are K_h of Eq. 9
    low: Camera  # the same view at 1/s of the resolution; K_l of Eq. 7
    scale: int  # s

    @classmethod
    def of(cls, camera: Camera, scale: int) -> View:
        """Make the view of `camera`; low resolution is 1/`scale` of its own, rounded up."""
        width, height = -(-camera.width // scale), -(-camera.height // scale)
        full = replace(camera, width=width * scale, height=height * scale)
        return cls(full, scale_camera(full, width, height), scale)

    def crop(self, left: int, top: int, width: int, height: int) -> View:
        """Crop to `width` x `height` low-resolution pixels, the first of them at `left`, `top`."""
        s = self.scale
        full = crop_camera(self.full, left * s, top * s, width * s, height * s)
        return View(full, crop_camera(self.low, left, top, width, height), s)
