"""What Hydra says about a sweep before its first job, in the process that began it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from hydra.core.global_hydra import GlobalHydra
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from sweeps.overrides import swept


class SweepCallback(Callback):
    """Notes the sweep that begins; run.yaml names it among Hydra's callbacks.

    Hydra makes the object and gives it to nobody, so the notes are on the class.

    Attributes:
        folder: where the jobs write how they ended; None without a sweep.
        sizes: the number of values of each setting that has several.
    """

    folder: ClassVar[Path | None] = None
    sizes: ClassVar[dict[str, int]] = {}

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note the folder of the sweep and its size."""
        SweepCallback.folder = Path(config.hydra.sweep.dir)
        params = config.hydra.sweeper.get("params") or {}
        words = [f"{name}={values}" for name, values in params.items()]
        loader = GlobalHydra.instance().config_loader()
        values = swept([*words, *config.hydra.overrides.task], loader)
        SweepCallback.sizes = {name: len(several) for name, several in values.items()}
