"""Distilled views: pictures of the stage 1 field at random cameras, as further training views."""

from __future__ import annotations

import time

import torch
from torch import Tensor

from bench.cameras import pack_camera, place_camera, unpack_camera
from bench.motion import novel_view, viewing_target
from bench.sharing import missing
from bench.sources import digest
from bench.types import Budget, Camera, Log, NullProbe, Scene
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.rendering.frame import everywhere, render_frame
from methods.steernerf.training.sequences import TrueView
from methods.training import checkpoint


def distilled_views(
    setup: Setup, trained: TrainedField, scene: Scene, budget: Budget, count: int, log: Log
) -> tuple[list[TrueView], float]:
    """Render `count` random views among the training cameras with `trained`, at full resolution.

    They are cached, by `setup`, `scene`, `budget` and `count`.

    Returns:
        the views, and the seconds that it took to render them.
    """
    if not count:
        return [], 0.0
    key = {**setup.key(scene, budget), "views": count, "distillation": digest(distilled_views)}
    path = log.stage_dir("distilled", key) / "views.safetensors"
    with missing(path, log) as to_render:
        if to_render:
            generator = torch.Generator().manual_seed(setup.seed)
            taken, target = scene.splits["train"].cameras, viewing_target(scene)
            background = scene.background
            cameras = [novel_view(taken, target, generator) for _ in range(count)]
            began, tensors = time.monotonic(), {}
            with log.progress("distilling", count) as progress:
                for number, camera in enumerate(cameras):
                    tensors[f"{number}.picture"] = _picture(trained, camera, background)
                    tensors[f"{number}.camera"] = pack_camera(camera)
                    progress.advance()
            figures = {"views": count, "seconds": time.monotonic() - began}
            checkpoint.write(path, tensors, figures)
    tensors, figures = checkpoint.read(path)
    with checkpoint.restoring(path):
        views = [
            TrueView(unpack_camera(tensors[f"{number}.camera"]), tensors[f"{number}.picture"])
            for number in range(int(figures["views"]))
        ]
        return views, figures["seconds"]


def _picture(trained: TrainedField, camera: Camera, background: Tensor) -> Tensor:
    """Render one view: uint8 [H, W, 3]."""
    field, probe = trained.field, NullProbe()
    camera, background = place_camera(camera, field.device), background.to(field.device)
    render = everywhere(field, trained.occupancy, probe, trained.sampling)
    frame = render_frame(camera, trained.occupancy, background, probe, render)
    return (frame.values.clamp(0, 1) * 255).round().to(torch.uint8).cpu()
