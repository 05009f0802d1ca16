"""Where Gaussians start."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from bench.types import Rays, Scene
from methods.gaussians import start
from methods.kernels.types import Pixels


def test_points_come_from_all_pictures_alike(
    ball_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three of five pixels show matter, at their camera."""

    def render(field: Any, rays: Rays, *_: Any) -> Pixels:
        alpha = torch.arange(len(rays.origins)) % 5 < 3
        return replace(Pixels.blank(len(alpha), 3), alpha=alpha.float())

    monkeypatch.setattr(start, "render_rays", render)
    field = SimpleNamespace(device=torch.device("cpu"))
    trained: Any = SimpleNamespace(field=field, occupancy=None, sampling=None)
    cameras = ball_scene.splits["train"].cameras
    each = 30
    generator = torch.Generator().manual_seed(0)
    points, _ = start.on_surfaces(trained, ball_scene, each * len(cameras), generator)
    found = [int((points == camera.c2w[:, 3]).all(dim=1).sum()) for camera in cameras]
    # Two draws of 18 points a picture, of which five in six are taken; each can be off by 2.
    assert found == pytest.approx([each] * len(cameras), abs=4)
