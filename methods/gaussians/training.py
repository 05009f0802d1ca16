"""Training of Gaussians on pictures (Kerbl et al. 2023, Section 5): where they start, and how faded
ones are relocated and explore (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte
Carlo"). Their number is fixed.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional

from bench.cameras import place_camera, scale_camera
from bench.types import Camera, NullProbe, Scene, TwoTensors, composite
from methods.gaussians.kernels.projection import covariances
from methods.gaussians.kernels.ssim import ssim
from methods.gaussians.model import Gaussians
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.kernels.composite import STOP
from methods.kernels.march.contraction import HALF
from methods.kernels.settings import Checked, Count, Only, Positive
from methods.rendering.frame import render_rays
from methods.training import loop
from methods.training.checkpoint import Optimisers, Tensors

SOLID = 0.5  # opacity above which a ray counts as ending at a surface

NEIGHBOURS = 3

DEAD = 0.005  # a Gaussian whose opacity is at most this is dead, and is relocated

MOST_COPIES = 51  # maximum number of Gaussians in one place after a relocation, as in the release

STEEPNESS, FAINT = 100.0, 0.005
"""Noise falls off around the opacity `FAINT` as a sigmoid of this steepness (their Eq. 10)."""


@dataclass(frozen=True)
class Fitting(Checked):
    """How to train Gaussians, as `sweeps/configs/method/gaussians.yaml` explains; the learning rate
    of the means is in scene units."""

    means: float
    final_means: float
    scales: float
    rotations: float
    opacities: float
    colours: float
    similarity: float
    opacity_cost: float
    scale_cost: float
    noise: float
    every: Count
    relocate_from: float
    relocate_to: float
    half: float
    opacity: Annotated[float, Only("more than 0 and less than 1", lambda x: 0 < x < 1)]
    size: Positive


class GaussianTraining(loop.Training):
    """Trains Gaussians on one picture a step."""

    advice = "Try a smaller rate (method.fitting.means)."

    def __init__(
        self, gaussians: Gaussians, scene: Scene, steps: int, options: Fitting, setup: Setup
    ) -> None:
        self.gaussians, self.options, self.backend = gaussians, options, setup.backend
        self.steps = steps
        self.split, self.background = scene.splits["train"], scene.background.to(setup.device)
        self.endless = scene.space == "all"
        self.generator = setup.generator(setup.device)
        self.views: list[int] = []  # still to come in this pass over the pictures

    @cached_property
    def optimiser(self) -> torch.optim.Adam:
        """Created when first needed, like that of a field."""
        gaussians, options = self.gaussians, self.options
        rates = (
            (gaussians.means, options.means),
            (gaussians.log_scales, options.scales),
            (gaussians.rotations, options.rotations),
            (gaussians.logits, options.opacities),
            (gaussians.base, options.colours),
            (gaussians.view, options.colours / 20),
        )
        groups = [{"params": [parameter], "lr": rate} for parameter, rate in rates]
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def advance(self) -> dict[str, float]:
        options = self.options
        gaussians = self.gaussians
        share = self.step / self.steps
        camera, target = self._picture(half=share < options.half)
        pixels = gaussians.render(camera, STOP, NullProbe(), self.backend)
        background = self.background
        if self.endless:  # no gap may pass for the background: its colour is another one each time
            background = torch.rand(3, generator=self.generator, device=background.device)
        picture = pixels.over(background).values.view_as(target)
        if self.split.masks:
            picture, target = loop.as_known(picture, target)
        loss = (1 - options.similarity) * functional.l1_loss(picture, target)
        if options.similarity:
            loss = loss + options.similarity * (1 - ssim(picture, target, backend=self.backend))
        # Gaussians that are not needed fade. Far ones are large, and go far.
        scales = gaussians.log_scales.exp()
        before = gaussians.means.detach()
        if self.endless:
            before = before.clone()
            far = self._distances()
            scales = scales / far
        costs = options.opacity_cost * gaussians.opacities.mean()
        costs = costs + options.scale_cost * scales.mean()
        (loss + costs).backward()

        def error() -> Tensors:
            return {"": functional.mse_loss(picture, target)}

        errors = loop.look(self, error, {"picture": picture})
        rate = options.means * options.final_means**share
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.step()
        if self.endless:
            with torch.no_grad():
                gaussians.means.copy_(before.lerp(gaussians.means, far))
        self.optimiser.zero_grad(set_to_none=True)
        self.step += 1
        if options.relocate_from <= share < options.relocate_to and self.step % options.every == 0:
            relocate(gaussians, self.optimiser, self.generator)
        if options.noise:
            disturb(gaussians, options.noise * rate, self.generator)
        return errors

    def _distances(self) -> Tensor:
        """n of the means, see `contraction`, at least 1: [N, 1]."""
        away = (self.gaussians.means.detach() - 0.5).abs().amax(dim=1, keepdim=True)
        return (away / HALF).clamp(min=1)

    def _picture(self, half: bool) -> tuple[Camera, Tensor]:
        """The next training view and its picture [H, W, 3], NaN where pixels do not count; a pass
        uses every view once."""
        if not self.views:
            count = len(self.split)
            generator = self.generator
            order = torch.randperm(count, generator=generator, device=generator.device)
            self.views = order.tolist()
        view = self.views.pop()
        camera = self.split.cameras[view]
        device = self.background.device
        picture = composite(self.split.images[view].to(device, non_blocking=True), self.background)
        if (mask := self.split.mask(view)) is not None:
            picture[~mask.to(device)] = math.nan
        if half and min(camera.size) > 1:
            camera = scale_camera(camera, camera.width // 2, camera.height // 2)
            planes = picture.movedim(-1, 0)[None]
            size = (camera.height, camera.width)
            shrunk = functional.interpolate(planes, size=size, mode="area")
            picture = shrunk[0].movedim(0, -1).contiguous()
        return place_camera(camera, device), picture

    def optimisers(self) -> Optimisers:
        return {"adam": self.optimiser}

    def watched(self) -> Tensors:
        return dict(self.gaussians.named_parameters())

    def result(self) -> Tensors:
        return {name: value.detach() for name, value in self.gaussians.named_parameters()}

    def restore_result(self, tensors: Tensors) -> None:
        self.gaussians.load_state_dict({name: tensors[name] for name in self.result()})

    def state(self) -> Tensors:
        return super().state() | {"views": torch.tensor(self.views, dtype=torch.int64)}

    def restore(self, tensors: Tensors) -> None:
        super().restore(tensors)
        self.views = tensors["views"].tolist()


def on_surfaces(
    teacher: TrainedField, scene: Scene, count: int, generator: torch.Generator
) -> TwoTensors:
    """Choose `count` points where rays of random training pixels end, and their colours: [count, 3]
    each. If the pictures show too little matter, points are taken more than once."""
    field = teacher.field
    batches = PixelBatches(scene.splits["train"], field.device)
    points, colours = [], []
    for _ in range(64):  # too few if less than 1/64 of the pixels show matter
        rays, _ = batches.draw(count, generator)
        pixels = render_rays(field, rays, teacher.occupancy, NullProbe(), teacher.sampling)
        hit = pixels.alpha > SOLID
        depth = pixels.depth_sum[hit] / pixels.alpha[hit]
        points.append(rays.origins[hit] + depth[:, None] * rays.directions[hit])
        colours.append(pixels.values[hit, :3] / pixels.alpha[hit, None])
        if sum(map(len, points)) >= count:
            break
    if not (total := sum(map(len, points))):
        return anywhere(scene, count, generator)
    # Evenly spread, because rays are drawn picture by picture.
    index = torch.arange(count, device=field.device) * total // count
    return torch.cat(points)[index], torch.cat(colours)[index].clamp(0, 1)


def anywhere(scene: Scene, count: int, generator: torch.Generator) -> TwoTensors:
    """Draw `count` points uniformly inside the bounds of `scene`, with random colours."""
    low, high = scene.bounds.to(generator.device)
    unit, colours = torch.rand(2, count, 3, generator=generator, device=generator.device)
    return low + unit * (high - low), colours


def spacing(points: Tensor) -> Tensor:
    """Root mean square distance [N] of each point from its nearest neighbours, more than 0."""
    if len(points) <= NEIGHBOURS:
        return torch.full_like(points[:, 0], 0.01)
    places = points.cpu().numpy()
    distances, _ = KDTree(places).query(places, NEIGHBOURS + 1, workers=torch.get_num_threads())
    mean = np.sqrt(np.square(distances[:, 1:]).mean(axis=1))
    return torch.from_numpy(mean).to(points).clamp(min=1e-5)


@torch.no_grad()
def relocate(
    gaussians: Gaussians, optimiser: torch.optim.Optimizer, generator: torch.Generator
) -> int:
    """Move dead Gaussians to living ones, drawn in proportion to opacity; return how many moved.
    Together, a living one and its copies look as it did alone (their Eq. 9). The optimiser's
    moments of all Gaussians that changed are set to 0."""
    opacities = gaussians.opacities
    dead = (opacities <= DEAD).nonzero().squeeze(1)
    alive = (opacities > DEAD).nonzero().squeeze(1)
    if not len(dead) or not len(alive):
        return 0
    drawn = torch.multinomial(opacities[alive], len(dead), replacement=True, generator=generator)
    source = alive[drawn]
    copies = torch.bincount(source, minlength=len(gaussians))[source] + 1
    opacity, shrink = shared_between(opacities[source], copies)
    gaussians.logits[source] = opacity.clamp(DEAD, 1 - 1e-6).logit()
    gaussians.log_scales[source] += shrink.log()[:, None]
    for parameter in gaussians.parameters():
        parameter[dead] = parameter[source]
    changed = torch.cat((dead, source))
    for state in optimiser.state.values():
        for name in ("exp_avg", "exp_avg_sq"):
            state[name][changed] = 0
    return len(dead)


def shared_between(opacities: Tensor, copies: Tensor) -> TwoTensors:
    """Opacity of each of `copies` [N] Gaussians that replace one of `opacities` [N], and the factor
    on its scales (Eq. 9): 1 - (1 - o_new)^n = o, and the factor keeps the integral of the opacity
    along a ray through the centre."""
    copies = copies.clamp(1, MOST_COPIES)
    new = 1 - (1 - opacities.double()) ** (1 / copies)
    total = torch.zeros_like(new)
    for i in range(1, int(copies.max()) + 1):
        terms = sum(
            math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1) for k in range(i)
        )
        total += torch.where(copies >= i, terms, 0.0)
    return new.float(), (opacities / total).float()


@torch.no_grad()
def disturb(gaussians: Gaussians, amount: float, generator: torch.Generator) -> None:
    """Add noise to the means, in the shape of each Gaussian, and more the fainter it is (Eq. 8)."""
    means = gaussians.means
    faintness = torch.sigmoid(STEEPNESS * (FAINT - gaussians.opacities))
    noise = torch.randn(means.shape, generator=generator, device=means.device)
    spread = covariances(gaussians.log_scales.exp(), gaussians.rotations)
    means.add_(amount * (spread @ (faintness[:, None] * noise)[:, :, None]).squeeze(2))
