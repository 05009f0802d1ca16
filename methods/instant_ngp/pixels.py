"""The pixels of all training pictures, the rays through them, and which ones are drawn."""

import torch
from torch import Tensor
from torch.nn import functional

from bench.errors import unexpected
from bench.types import Rays, Split

STRIP = 8
"""Width of the strips of a picture in which its pixels are numbered, row by row: a run of `RUN`
pixels is then mostly 8 wide and 16 high, and its pixels are alike."""

RUN = 128  # consecutive pixels that share one estimate of an error

REFRESHED = 16
"""Steps after which the chances of the runs follow their estimates: they change slowly, and summing
up those of half a million runs takes longer than drawing from them."""

UNSEEN = 0.1  # estimate for a run that no ray has met yet: about that of an untrained field


def one_from_each(count: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """Draw one number from each of `count` equal parts of [0, 1), in order: [count] float64. It may
    be rounded up to where the next part begins, be it 1."""
    places = torch.rand(count, dtype=torch.float64, generator=generator, device=device)
    return (places + torch.arange(count, device=device)) / count


class PixelBatches:
    """Random pixels of the pictures of a split, with their rays. Pixels that count are numbered
    picture by picture, strip by strip from left to right, row by row."""

    def __init__(self, split: Split, device: torch.device) -> None:
        self._device = device
        channels = max(picture.shape[-1] for picture in split.images)
        pictures = []
        for picture in split.images:
            strips = torch.cat([strip.flatten(0, 1) for strip in picture.split(STRIP, dim=1)])
            # An opaque picture among transparent ones gets an alpha of 255.
            pictures.append(functional.pad(strips, (0, channels - strips.shape[-1]), value=255))
        self._pixels = torch.cat([p.to(device) for p in pictures])  # [P, 3 or 4] uint8
        ends = torch.tensor([len(picture) for picture in pictures]).cumsum(0)
        self._ends = ends.to(device)  # of each picture in `_pixels`
        self._counted: Tensor | None = None  # numbers of the pixels that count; None: all do
        if split.masks:
            pairs = zip(split.images, split.masks, strict=True)
            whole = [torch.ones(x.shape[:2]).bool() if mask is None else mask for x, mask in pairs]
            counts = [strip.flatten() for mask in whole for strip in mask.split(STRIP, dim=1)]
            self._counted = torch.cat(counts).nonzero().squeeze(1).to(device)
            if not len(self._counted):
                raise unexpected("masks of the training pictures", "a pixel that counts", "none")

        cameras = split.cameras
        starts = (0, *ends.tolist())
        # Where each picture starts in `_pixels`, its width and height.
        of_each = [(start, *c.size) for start, c in zip(starts, cameras, strict=False)]
        self._pictures = torch.tensor(of_each, device=device)
        # In double precision, because corner and steps cancel for the most part.
        poses = torch.stack([c.c2w for c in cameras]).double().cpu()  # [N, 3, 4]
        inside = torch.tensor([c.intrinsics for c in cameras], dtype=torch.float64)
        fx, fy, cx, cy = inside.T[..., None]
        # A step in the picture, to the right and down, the ray through its upper left corner, and
        # the centre: [N, 4, 3].
        right = poses[:, :, 0] / fx
        down = poses[:, :, 1] / fy
        corner = poses[:, :, 2] - cx * right - cy * down
        self._rays = torch.stack((right, down, corner, poses[:, :, 3]), dim=1).float().to(device)

    def __len__(self) -> int:
        return len(self._pixels if self._counted is None else self._counted)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor]:
        """Draw `count` rays through pixel centres, and their colours [count, 3 or 4] in [0, 1]."""
        return self.at(self.choose(count, generator))

    def choose(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw the numbers [count] of pixels, in order: one from each of `count` equal parts of all
        pixels, so that neighbours are fetched together."""
        places = one_from_each(count, generator, self._device) * len(self)
        return places.long().clamp(max=len(self) - 1)

    def at(self, pixel: Tensor) -> tuple[Rays, Tensor]:
        """The rays through the centres of the pixels with the numbers `pixel` [R], and their
        colours [R, 3 or 4] in [0, 1]."""
        if self._counted is not None:
            pixel = self._counted.index_select(0, pixel)
        view = torch.searchsorted(self._ends, pixel, right=True)
        start, width, height = self._pictures.index_select(0, view).unbind(dim=1)
        within = pixel - start
        strip = within // (STRIP * height)
        left = STRIP * strip
        strip_width = (width - left).clamp(max=STRIP)  # the last strip of a picture may be narrower
        within -= left * height
        row = within // strip_width
        column = left + within - row * strip_width
        right, down, corner, centre = self._rays.index_select(0, view).unbind(dim=1)
        directions = corner.addcmul(column[:, None] + 0.5, right)
        directions.addcmul_(row[:, None] + 0.5, down)
        colours = self._pixels.index_select(0, pixel).float() / 255
        return Rays(centre, directions), colours


class ErrorMap:
    """Running estimates of the squared error of each run of pixels.

    A run is drawn in proportion to the root of its error, its root mean square error, to which the
    gradients of its pixels are proportional. The chances are not made up for by weights: the loss
    then counts wrong pixels more, and has less noise. There are `pixels` pixels in all pictures.
    """

    def __init__(self, pixels: int, device: torch.device) -> None:
        self._pixels = pixels
        # [T] mean squared error of each run; each new pixel counts as much as the estimate.
        self.errors = torch.full((-(-pixels // RUN),), UNSEEN, device=device)
        self._met = torch.ones_like(self.errors)  # 1, plus the pixels met while `learn` runs
        self.refresh()

    def refresh(self) -> None:
        """Let the chances follow the estimates; `ends` [T] sums them up to each run."""
        self.ends = self.errors.sqrt().cumsum(0, dtype=torch.float64)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw the numbers [count] of pixels, in the order of their runs."""
        device, ends = self.errors.device, self.ends
        places = one_from_each(count, generator, device) * ends[-1]
        run = torch.searchsorted(ends, places).clamp(max=len(ends) - 1)
        within = torch.randint(RUN, (count,), generator=generator, device=device)
        return (run * RUN + within).clamp(max=self._pixels - 1)

    def learn(self, pixels: Tensor, errors: Tensor) -> None:
        """Update the estimates with the squared `errors` [R] of some `pixels` [R]."""
        run = pixels // RUN
        self._met.index_add_(0, run, torch.ones_like(errors))
        self.errors.index_add_(0, run, errors)
        means = self.errors.index_select(0, run) / self._met.index_select(0, run)
        self.errors.index_copy_(0, run, means)  # a run that appears twice has the same mean twice
        self._met.index_fill_(0, run, 1)
