"""Distilled views: pictures of the stage 1 field at random cameras, as further training views
(Section 3.5)."""

from __future__ import annotations

import time

import torch
from torch import Tensor

from bench.cameras import pack_camera, place_camera, unpack_camera
from bench.motion import novel_view, viewing_target
from bench.provenance import digest
from bench.sharing import missing
from bench.types import Budget, Camera, Log, NullProbe, Scene, Split
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.rendering.frame import everywhere, render_frame
from methods.training import checkpoint


def distilled_views(
    setup: Setup, trained: TrainedField, scene: Scene, budget: Budget, count: int, log: Log
) -> tuple[Split, float]:
    """Render `count` random views among the training cameras with `trained`, at full resolution.

    They are cached, by `setup`, `scene`, `budget` and `count`.

    Returns:
        the views, and the seconds that it took to render them.
    """
    if not count:
        return Split([], [], []), 0.0
    key = {**setup.key(scene, budget), "views": count, "distillation": digest(distilled_views)}
    path = log.stage_dir("distilled", key) / "views.safetensors"
    names = [str(number) for number in range(count)]
    with missing(path, log) as to_render:
        if to_render:
            generator = torch.Generator().manual_seed(setup.seed)
            taken, target = scene.splits["train"].cameras, viewing_target(scene)
            cameras = [novel_view(taken, target, generator) for _ in names]
            began, tensors = time.monotonic(), {}
            with log.progress("distilling", count) as progress:
                for name, camera in zip(names, cameras, strict=True):
                    tensors[f"{name}.picture"] = _picture(trained, camera, scene.background)
                    tensors[f"{name}.camera"] = pack_camera(camera)
                    progress.advance()
            checkpoint.write(path, tensors, {"seconds": time.monotonic() - began})
    tensors, figures = checkpoint.read(path)
    with checkpoint.restoring(path):
        cameras = [unpack_camera(tensors[f"{name}.camera"]) for name in names]
        pictures = [tensors[f"{name}.picture"] for name in names]
        return Split(cameras, pictures, names), figures["seconds"]


def _picture(trained: TrainedField, camera: Camera, background: Tensor) -> Tensor:
    """Render one view: uint8 [H, W, 3]."""
    field, probe = trained.field, NullProbe()
    camera, background = place_camera(camera, field.device), background.to(field.device)
    render = everywhere(field, trained.occupancy, probe, trained.sampling)
    frame = render_frame(camera, trained.occupancy, background, probe, render)
    return (frame.values.clamp(0, 1) * 255).round().to(torch.uint8).cpu()
