"""Training a field on the pictures of a scene: the loop, its checkpoints and its guards."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from bench.provenance import digest
from bench.types import Budget, Log, Rays, Scene, Split, SteerbenchError
from methods.fields import HashField
from methods.kernels.adam import AdamState, sparse_adam_
from methods.occupancy import EVERY, DensityGrid
from methods.volume import render_batch

CHECKPOINT_S = 20.0
"""Seconds between checkpoints: what a killed training loses at most."""

UNTRAINED_SOURCES = ("case", "cases", "benchmark")
"""Modules of the kernels that no training runs through."""

GRID_YOUTH_STEPS = 256
"""Until this step the density grid is visited four times as much: most of it is still unknown."""


@dataclass(frozen=True)
class TrainingOptions:
    """How a field is trained; the defaults follow ngp_pl where facts are known.

    Attributes:
        rate: learning rate at the beginning, of table and networks.
        final_rate: share of `rate` left at the end of the cosine schedule.
        opacity_entropy: weight of -o ln o, which drives the opacity of a ray to 0 or 1.
        random_background: train RGBA pictures on a random colour a ray instead of the scene's
            background, so that no density can pass for background.
        grid_samples: visits of an update of the density grid.
        max_rays: most rays of a step.
    """

    rate: float = 1e-2
    final_rate: float = 1 / 30
    opacity_entropy: float = 1e-3
    random_background: bool = True
    grid_samples: int = 1 << 17
    max_rays: int = 1 << 15


class PixelBatches:
    """Random pixels of the pictures of a split, with their rays."""

    def __init__(self, split: Split, device: torch.device) -> None:
        self._device = device
        self._pictures = [picture.reshape(-1, picture.shape[-1]) for picture in split.images]
        sizes = torch.tensor([len(picture) for picture in self._pictures])
        self._ends = sizes.cumsum(0).to(device)
        self._pixels = torch.cat([p.to(device) for p in self._pictures])  # [P, 3 or 4] uint8
        cameras = split.cameras
        self._widths = torch.tensor([c.width for c in cameras], device=device)
        self._poses = torch.stack([c.c2w for c in cameras]).to(device)  # [N, 3, 4]
        self._intrinsics = torch.tensor(
            [(c.fx, c.fy, c.cx, c.cy) for c in cameras], device=device
        )  # [N, 4]

    def draw(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor]:
        """`count` rays through pixel centres, and their colours [count, 3 or 4] in [0, 1]."""
        total = len(self._pixels)
        pixel = torch.randint(total, (count,), generator=generator, device=self._device)
        view = torch.searchsorted(self._ends, pixel, right=True)
        within = pixel - torch.where(view > 0, self._ends[view - 1], 0)
        width = self._widths[view]
        u, v = within % width + 0.5, within // width + 0.5
        fx, fy, cx, cy = self._intrinsics[view].unbind(dim=-1)
        local = torch.stack(((u - cx) / fx, (v - cy) / fy, torch.ones_like(fx)), dim=-1)
        pose = self._poses[view]
        directions = (pose[:, :, :3] * local[:, None]).sum(dim=-1)
        return Rays(pose[:, :, 3].contiguous(), directions), self._pixels[pixel].float() / 255


class FieldTraining:
    """The state of a training: what a checkpoint must hold to go on as if it had never stopped."""

    def __init__(
        self, field: HashField, scene: Scene, budget: Budget, options: TrainingOptions, seed: int
    ) -> None:
        device = field.table.device
        self.field, self.budget, self.options = field, budget, options
        self.grid = DensityGrid(scene.bounds, device)
        self.batches = PixelBatches(scene.splits["train"], device)
        self.background = scene.background.to(device)
        self.step = 0
        self.rays = 1024
        self.seconds = 0.0
        self.generator = torch.Generator(device).manual_seed(seed)
        self.table_state = AdamState.like(field.table.detach())
        self.network_optimiser = torch.optim.Adam(
            list(field.layers.values()), lr=options.rate, betas=(0.9, 0.99), eps=1e-15
        )
        field.grad_buffer = torch.zeros_like(field.table)

    def learning_rate(self) -> float:
        """Cosine from `rate` to `rate * final_rate`: monotone."""
        low = self.options.final_rate
        done = self.step / self.budget.steps
        return self.options.rate * (low + (1 - low) * 0.5 * (1 + math.cos(math.pi * done)))

    def advance(self) -> float:
        """One step; returns the loss.

        Raises:
            SteerbenchError: the loss is not finite.
        """
        if self.step % EVERY == 0:
            young = self.step < GRID_YOUTH_STEPS
            samples = self.options.grid_samples * (4 if young else 1)
            self.grid.update(self.field, self.generator, samples)
        rays, colours = self.batches.draw(self.rays, self.generator)
        target, background = self._target(colours)
        jitter = torch.rand(
            len(target), generator=self.generator, device=target.device, dtype=target.dtype
        )
        pixels, samples = render_batch(self.field, rays, self.grid.occupancy, jitter, background)
        loss = torch.nn.functional.mse_loss(pixels.values, target)
        opacity = pixels.alpha.clamp(1e-5, 1 - 1e-5)
        entropy = -(opacity * opacity.log()).mean()
        (loss + self.options.opacity_entropy * entropy).backward()
        value = loss.item()
        if not math.isfinite(value):
            raise self._not_finite(pixels.values)
        self._update()
        self._fit_batch(samples)
        self.step += 1
        return value

    def _target(self, colours: Tensor) -> tuple[Tensor, Tensor]:
        """Colours composited on the background, and that background ([3] or a ray's own [R, 3])."""
        if colours.shape[-1] == 3:
            return colours, self.background
        background = self.background
        if self.options.random_background:
            background = torch.rand(
                len(colours), 3, generator=self.generator, device=colours.device
            )
        rgb, alpha = colours[:, :3], colours[:, 3:]
        return rgb * alpha + background * (1 - alpha), background

    def _update(self) -> None:
        rate = self.learning_rate()
        for group in self.network_optimiser.param_groups:
            group["lr"] = rate
        self.network_optimiser.step()
        self.network_optimiser.zero_grad(set_to_none=True)
        assert self.field.grad_buffer is not None
        sparse_adam_(
            self.field.table.detach(),
            self.field.grad_buffer,
            self.table_state,
            rate,
            packed=self.field.packed,
            backend=self.field.backend,
        )

    def _fit_batch(self, samples: int) -> None:
        """Choose the next number of rays so that it brings about `budget.samples` samples."""
        wanted = self.rays * self.budget.samples / max(samples, 1)
        change = min(max(wanted / self.rays, 0.5), 1.25)
        self.rays = min(max(int(self.rays * change), 64), self.options.max_rays)

    def _not_finite(self, rendered: Tensor) -> SteerbenchError:
        tensors = {"rendered pixels": rendered, "table": self.field.table}
        tensors |= dict(self.field.layers.items())
        bad = [name for name, tensor in tensors.items() if not tensor.isfinite().all()]
        return SteerbenchError(
            f"training stopped at step {self.step}: the loss is not finite "
            f"(not finite: {', '.join(bad) or 'only the loss'}); the last good checkpoint was "
            "kept. Try a smaller learning rate (method.training.rate)."
        )


@cache
def training_digest() -> str:
    """SHA-256 of the sources that decide what a training results in."""
    folder = Path(__file__).parent
    sources = [folder / f"{name}.py" for name in ("train", "fields", "occupancy", "volume")]
    kernels = [p for p in (folder / "kernels").rglob("*.py") if p.stem not in UNTRAINED_SOURCES]
    return digest(sources + kernels)


def train_field(
    field: HashField,
    scene: Scene,
    budget: Budget,
    options: TrainingOptions,
    seed: int,
    folder: Path,
    log: Log,
) -> tuple[DensityGrid, float]:
    """Train `field` on the pictures of `scene`; its density grid and the seconds it took.

    The result stands in `folder` as `field.safetensors`; a training that is found there is loaded,
    one that was killed goes on from its last checkpoint.
    """
    training = FieldTraining(field, scene, budget, options, seed)
    if (finished := folder / "field.safetensors").exists():
        _load(training, finished)
        log.info(f"trained field found: {finished}")
    else:
        _run(training, folder, log)
    field.grad_buffer = None
    return training.grid, training.seconds


def _run(training: FieldTraining, folder: Path, log: Log) -> None:
    checkpoint = folder / "checkpoint.safetensors"
    if checkpoint.exists():
        _load(training, checkpoint)
        log.info(f"going on from step {training.step} of {checkpoint}")
    steps = training.budget.steps
    began, saved = time.monotonic() - training.seconds, time.monotonic()
    mean = math.nan
    with log.progress("training", steps) as progress:
        progress.advance(training.step)
        while training.step < steps:
            loss = training.advance()
            mean = loss if math.isnan(mean) else 0.99 * mean + 0.01 * loss
            progress.advance(note=f"{-10 * math.log10(max(mean, 1e-10)):.1f} dB")
            training.seconds = time.monotonic() - began
            if time.monotonic() - saved > CHECKPOINT_S:
                _save(training, checkpoint)
                saved = time.monotonic()
    _save(training, folder / "field.safetensors", finished=True)
    checkpoint.unlink(missing_ok=True)


def _tensors(training: FieldTraining, finished: bool) -> dict[str, Tensor]:
    tensors = {"field." + name: value for name, value in training.field.state_dict().items()}
    tensors["grid.density"] = training.grid.density
    if finished:
        return tensors
    state = training.table_state
    tensors |= {"adam.first": state.first, "adam.second": state.second, "adam.steps": state.steps}
    tensors["generator"] = training.generator.get_state()
    for index, slots in training.network_optimiser.state_dict()["state"].items():
        tensors |= {f"network.{index}.{name}": value for name, value in slots.items()}
    return tensors


def _save(training: FieldTraining, path: Path, finished: bool = False) -> None:
    """Write a checkpoint under a temporary name and rename it: never half a file."""
    meta = {"step": training.step, "rays": training.rays, "seconds": training.seconds}
    temporary = path.with_suffix(".tmp")
    try:
        save_file(_tensors(training, finished), temporary, {"training": json.dumps(meta)})
        temporary.replace(path)
    except (OSError, SafetensorError) as error:
        temporary.unlink(missing_ok=True)
        raise SteerbenchError(f"{path}: cannot write the checkpoint: {error}") from error


def _load(training: FieldTraining, path: Path) -> None:
    with safe_open(path, "pt") as file:
        meta: Mapping[str, float] = json.loads(file.metadata()["training"])
    tensors = load_file(path, device=str(training.field.table.device))
    training.step, training.rays = int(meta["step"]), int(meta["rays"])
    training.seconds = float(meta["seconds"])
    training.field.load_state_dict(
        {name[6:]: value for name, value in tensors.items() if name.startswith("field.")}
    )
    training.field.repack()
    training.grid.restore(tensors["grid.density"])
    if "generator" not in tensors:
        return
    training.table_state = AdamState(
        tensors["adam.first"], tensors["adam.second"], tensors["adam.steps"]
    )
    training.generator.set_state(tensors["generator"].cpu())
    state = training.network_optimiser.state_dict()
    for name, value in tensors.items():
        if name.startswith("network."):
            _, index, slot = name.split(".")
            state["state"].setdefault(int(index), {})[slot] = value
    training.network_optimiser.load_state_dict(state)
