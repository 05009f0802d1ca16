"""Masks of pictures: which pixels count. The others are neither learnt from nor scored."""

import os
from pathlib import Path

from torch import Tensor
from torch.nn import functional

from bench.scenes.files import Fields
from bench.scenes.images import Pictures, ScaledView, decode, undistort
from bench.scenes.lookup import found, in_any_case


def frame_mask(root: Path, settings: Fields, picture: Path) -> tuple[Path | None, bool]:
    """`mask` and `hides` of the view of a frame in `transforms.json`: those of its `mask_path` or
    of instant-ngp's mask beside the picture."""
    if (given := settings.get("mask_path")) is None:
        beside = picture.with_name(f"dynamic_mask_{picture.stem}.png")
        return (beside, True) if beside.is_file() else (None, False)
    if not isinstance(given, str):
        raise settings.wrong("mask_path", "a path")
    return found(root, given, settings.place("mask_path"), "a picture"), False


def mask_folder(root: Path, images: str, masks: str | None) -> Path | None:
    """The folder `masks` of COLMAP's masks. "auto": `masks`, for `images_4` also `masks_4`; None if
    there is none, or `masks` is None."""
    if masks is None or masks == "auto":
        places = (root / f"masks{images.removeprefix('images')}", root / "masks")
        there = (in_any_case(place, os.path.isdir) for place in places)
        return next(filter(None, there), None) if masks else None
    return found(root, masks, "scene.masks", "a folder of masks", os.path.isdir)


def mask_in(folder: Path, name: str) -> Path | None:
    """The mask NAME.png of a picture, where NAME may lack its ending."""
    files = folder / f"{name}.png", (folder / name).with_suffix(".png")
    return next(filter(Path.is_file, files), None)


class Masks(Pictures):
    """Which pixels of the `described` pictures count, bool [H, W] each: those of which no part is
    masked; None: all. Decoded as pictures are."""

    def _read(self, picture: ScaledView) -> Tensor | None:
        if picture.mask is None:
            return None
        view = picture.view
        levels = decode(picture.mask)[..., :3]
        lossy = picture.mask.view.path.suffix.lower() in (".jpg", ".jpeg")
        black = levels.max() // 2 if lossy else 0  # that of a JPEG is nearly black
        masked = (levels > black).any(-1) == view.hides
        if view.lens:
            masked = undistort(255 * masked.byte()[..., None], view.camera, view.lens)[..., 0] > 0
        return functional.max_pool2d(masked.float()[None], picture.downscale)[0] == 0
