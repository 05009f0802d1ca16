"""Masks of pictures: which pixels count. The others are neither learnt from nor scored."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor
from torch.nn import functional

from bench.errors import unexpected
from bench.scenes.files import describe, inside
from bench.scenes.images import Pictures, ScaledView, View, decode, undistort
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
    return inside(root, given, f"{where}.mask_path"), False


def with_masks(
    views: Sequence[View], root: Path, images: str, masks: str | None, log: Log
) -> Sequence[View]:
    """COLMAP's pictures, whose folder is `images`, with the masks NAME.png in the folder `masks`,
    where NAME may lack its ending. "auto": `masks`, for `images_4` also `masks_4`; None: no masks.
    If no picture has its mask there, that is logged."""
    auto = [f"masks{images.removeprefix('images')}", "masks"]
    places = auto if masks == "auto" else [masks] if masks else []
    folders = [inside(root, place, "scene.masks") for place in places]
    folder = next(filter(Path.is_dir, folders), None)
    if folder is None:
        if masks not in ("auto", None):
            raise unexpected("scene.masks", f"a folder in {root}", repr(masks))
        return views
    found = []
    for view in views:
        files = folder / f"{view.name}.png", (folder / view.name).with_suffix(".png")
        found.append(replace(view, mask=next(filter(Path.is_file, files), None)))
    if not any(view.mask for view in found):
        log.info(f"{folder}: not used: no picture has its mask there, {views[0].name}.png or so")
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
