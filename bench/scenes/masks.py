"""Masks of pictures: which pixels count. The others are neither learnt from nor scored."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from torch import Tensor
from torch.nn import functional

from bench.errors import unexpected
from bench.scenes.files import describe
from bench.scenes.images import Pictures, ScaledView, decode, undistort
from bench.scenes.lookup import absent, in_any_case, tidy
from bench.scenes.splits import Listed
from bench.types import Log


def frame_mask(
    root: Path, settings: Mapping, picture: Path, where: str
) -> tuple[Path | None, bool]:
    """`mask` and `hides` of the view of a frame in `transforms.json`: those of its `mask_path` or
    of instant-ngp's mask beside the picture."""
    if (given := settings.get("mask_path")) is None:
        beside = picture.with_name(f"dynamic_mask_{picture.stem}.png")
        return (beside, True) if beside.is_file() else (None, False)
    if not isinstance(given, str):
        raise unexpected(f"{where}.mask_path", "a path", describe(given))
    if (mask := in_any_case(root / tidy(given))) is None:
        raise unexpected(f"{where}.mask_path", "a picture", absent(root, given))
    return mask, False


def with_masks(listed: Listed, root: Path, images: str, masks: str | None, log: Log) -> Listed:
    """COLMAP's pictures, whose folder is `images`, with the masks NAME.png in the folder `masks`,
    where NAME may lack its ending. "auto": `masks`, for `images_4` also `masks_4`; None: no masks.
    If no picture has its mask there, that is logged."""
    auto = [f"masks{images.removeprefix('images')}", "masks"]
    places = auto if masks == "auto" else [masks] if masks else []
    folders = (in_any_case(root / tidy(place), os.path.isdir) for place in places)
    folder = next(filter(None, folders), None)
    if folder is None:
        if masks not in ("auto", None):
            raise unexpected("scene.masks", "a folder of masks", absent(root, str(masks)))
        return listed
    found = []
    for name, view in listed:
        files = folder / f"{name}.png", (folder / name).with_suffix(".png")
        mask = next(filter(Path.is_file, files), None)
        found.append((name, view and replace(view, mask=mask)))
    if not any(view and view.mask for _, view in found):
        log.info(f"{folder}: not used: no picture has its mask there, {listed[0][0]}.png or so")
    return found


class Masks(Pictures):
    """Which pixels of the `described` pictures count, bool [H, W] each: those of which no part is
    masked; None: all. Decoded as pictures are."""

    def _read(self, picture: ScaledView) -> Tensor | None:
        if picture.mask is None:
            return None
        view = picture.view
        masked = (decode(picture.mask)[..., :3] > 0).any(-1) == view.hides
        if view.lens:
            masked = undistort(255 * masked.byte()[..., None], view.camera, view.lens)[..., 0] > 0
        return functional.max_pool2d(masked.float()[None], picture.downscale)[0] == 0
