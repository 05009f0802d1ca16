"""The protocol: the rules of a fair measurement. Its name is in every row."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from bench import metrics, video_metrics
from bench.errors import unexpected
from bench.provenance import sha256
from bench.trajectories import Trajectory
from bench.types import BACKGROUNDS, Log, Scene, SteerbenchError, Unavailable
from bench.waits import device_waits
from bench.weights import locate

CHOICES = {"background": tuple(BACKGROUNDS), "flicker": ("split", "exact")}
CHOICES |= {"mask": ("scene", "none"), "colour_correction": ("none", "affine", "quadratic")}
"""The values of the protocol's options."""

COLUMNS = tuple(video_metrics.NEEDS)  # further metrics that a protocol can name


@dataclass(frozen=True)
class EvaluationProtocol:
    """How pictures are scored and how frames are timed.

    The flicker and most of `columns` need true pictures of consecutive frames: those with a ground
    truth have one ("split"), or the scene renders it for the other frames ("exact"), which takes
    about half a second at 400 x 400. Of several `rounds`, the first is scored, and the others give
    times and work.
    """

    name: str
    lpips: tuple[str, ...]  # backbones, each with a metric `lpips_<net>`
    lpips_every: int  # scored frames of which the last one has them; they take most time
    background: str  # onto which pictures with an opacity channel are composited
    mask: str  # "scene": pixels that the scene masks do not count; "none": all do
    colour_correction: str  # also metrics `cc_*` of pictures with corrected colours, by this fit
    warmup: int  # frames before the timed sequence, spread over the trajectory
    flicker: str
    stages: bool  # whether to time the stages of a frame: a GPU is waited for at each
    rounds: int  # through the trajectory
    compared: bool  # with the first in turns: `psnr_to_first`, `worst_to_first`
    waits: bool  # whether to note where the host waits for a GPU
    columns: tuple[str, ...]  # further metrics, of `COLUMNS`

    def __post_init__(self) -> None:
        for option in ("lpips", "columns"):  # a list, when read from YAML
            object.__setattr__(self, option, tuple(getattr(self, option)))
        for option, allowed in CHOICES.items():
            if getattr(self, option) not in allowed:
                value = repr(getattr(self, option))
                raise unexpected(f"protocol.{option}", " or ".join(allowed), value)
        for option, least in (("warmup", 0), ("lpips_every", 1), ("rounds", 1)):
            if (got := getattr(self, option)) < least:
                raise unexpected(f"protocol.{option}", f"{least} or more", got)
        if not set(self.columns) <= set(COLUMNS):
            raise unexpected("protocol.columns", f"some of {', '.join(COLUMNS)}", [*self.columns])

    @property
    def metric_names(self) -> Sequence[str]:
        """Names of the metrics that `score` returns, in the order of the table."""
        plain = ("psnr", "ssim", *(f"lpips_{net}" for net in self.lpips))
        corrected = [f"cc_{name}" for name in plain if self.colour_correction != "none"]
        return (*plain, *corrected)

    def check(self, scene: Scene, trajectory: Trajectory) -> None:
        """Raise SteerbenchError before any training if the frames could not be scored afterwards:
        another background, no exact pictures for the flicker, a frame smaller than a window; or if
        waits are to be noted and there is no GPU."""
        if self.waits:
            with device_waits():
                pass
        if self.flicker == "exact" and scene.exact is None:
            raise SteerbenchError(
                f"protocol.flicker=exact: scene {scene.name} has no exact pictures, expected an "
                "embedded one; use protocol.flicker=split"
            )
        wanted = torch.full((3,), BACKGROUNDS[self.background])
        if not torch.equal(scene.background.cpu().float(), wanted):
            got = ", ".join(f"{value:g}" for value in scene.background.tolist())
            raise SteerbenchError(
                f"protocol {self.name} scores on {self.background}, but scene {scene.name} has "
                f"background [{got}]: change scene.background, or use another protocol"
            )
        scored = (step.camera for step in trajectory.steps if step.truth is not None)
        for width, height in {camera.size for camera in scored}:
            for metric in self.metric_names:
                metrics.check_size(metric, width, height)

    def find_lpips(self, weights_dir: Path | None, log: Log) -> dict[str, str | None]:
        """SHA-256 of each backbone's weight file, None if missing: part of the run's key."""
        digests: dict[str, str | None] = dict.fromkeys(self.lpips)
        for net in self.lpips:
            with suppress(Unavailable):
                digests[net] = sha256(locate(net, weights_dir, log))
        return digests

    def load_lpips(
        self, weights_dir: Path | None, log: Log
    ) -> tuple[dict[str, metrics.Lpips], dict[str, str]]:
        """LPIPS by backbone; by metric, why it is missing, which is also logged."""
        loaded, missing = {}, {}
        for net in self.lpips:
            try:
                loaded[net] = metrics.Lpips(net, weights_dir, log)
            except Unavailable as error:
                missing[f"lpips_{net}"] = str(error)
                log.info(f"lpips_{net}: n/a. {error}")
        return loaded, missing

    def rounded(self, rgb: Tensor) -> Tensor:
        """A prediction [H, W, 3], rounded as for scoring."""
        return metrics.quantise(rgb.float())

    def score(
        self,
        rgb: Tensor,
        truth: Tensor,
        lpips: Mapping[str, metrics.Lpips],
        mask: Tensor | None = None,
    ) -> dict[str, float]:
        """Every metric of a prediction against its ground truth, both [H, W, 3] in [0, 1], and
        equal where a `mask` bool [H, W] says that pixels do not count.

        A backbone that is missing from `lpips` scores NaN, as all does where no pixel counts.
        """
        if mask is not None and not mask.any():
            return dict.fromkeys(self.metric_names, math.nan)
        scores, pictures = dict[str, float](), {"": rgb}
        if (fit := self.colour_correction) != "none":
            pictures["cc_"] = metrics.colour_corrected(rgb, truth, mask, fit == "quadratic")
        for kind, picture in pictures.items():
            image = self.rounded(picture)
            scores[f"{kind}psnr"] = metrics.psnr(image, truth, mask)
            scores[f"{kind}ssim"] = metrics.ssim(image, truth)
            for net in self.lpips:
                score = lpips[net](image, truth) if net in lpips else math.nan
                scores[f"{kind}lpips_{net}"] = score
        return scores
