"""Pictures that a trained field shows at views nobody photographed, to learn from as if true."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from bench.cameras import pack_camera, place_camera, unpack_camera
from bench.motion import novel_view
from bench.sharing import missing
from bench.types import Camera, Log, NullProbe, Scene
from methods.instant_ngp.stage1 import Pretrained
from methods.steernerf.range_reduction import render_guided
from methods.steernerf.training.sequences import TrueView
from methods.training import checkpoint


def distilled_views(
    trained: Pretrained,
    scene: Scene,
    target: Tensor,
    count: int,
    seed: int,
    folder: Path,
    log: Log,
) -> tuple[list[TrueView], float]:
    """`count` views among the training cameras as `trained` shows them at full resolution, and the
    seconds that it took to render them.

    Args:
        target: [3] the point that the cameras look at, more or less.
        folder: where they are kept, and found again.
    """
    path = folder / "views.safetensors"
    with missing(path, log) as to_render:
        if to_render:
            generator = torch.Generator().manual_seed(seed)
            taken = scene.splits["train"].cameras
            cameras = [novel_view(taken, target, generator) for _ in range(count)]
            began = time.monotonic()
            tensors = _rendered(trained, scene, cameras, log)
            seconds = time.monotonic() - began
            checkpoint.write(path, tensors, {"views": count, "seconds": seconds})
    tensors, figures = checkpoint.read(path)
    with checkpoint.restoring(path):
        views = [_unpacked(tensors, number) for number in range(int(figures["views"]))]
        return views, figures["seconds"]


def _rendered(
    trained: Pretrained, scene: Scene, views: Sequence[Camera], log: Log
) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    with log.progress("distilling", len(views)) as progress:
        for number, camera in enumerate(views):
            tensors |= _packed(number, camera, _picture(trained, camera, scene.background))
            progress.advance()
    return tensors


def _picture(trained: Pretrained, camera: Camera, background: Tensor) -> Tensor:
    """uint8 [H, W, 3]."""
    device = trained.field.table.device
    camera = place_camera(camera, device)
    rgb = render_guided(
        trained.field, camera, trained.occupancy, background.to(device), NullProbe(), None
    ).values
    return (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def _packed(number: int, camera: Camera, picture: Tensor) -> dict[str, Tensor]:
    return {f"{number}.picture": picture, f"{number}.camera": pack_camera(camera)}


def _unpacked(tensors: Mapping[str, Tensor], number: int) -> TrueView:
    return TrueView(unpack_camera(tensors[f"{number}.camera"]), tensors[f"{number}.picture"])
