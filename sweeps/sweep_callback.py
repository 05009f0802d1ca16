"""Records what Hydra knows about a sweep before its first job, in the process that started it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from hydra.core.global_hydra import GlobalHydra
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from sweeps.overrides import swept


class SweepCallback(Callback):
    """Records that a sweep starts; run.yaml lists it among Hydra's callbacks.

    Hydra creates the object and never hands it out, so the record is kept on the class.

    Attributes:
        folder: where jobs record how they ended; None without a sweep.
        sizes: number of values, for each setting with several values.
    """

    folder: ClassVar[Path | None] = None
    sizes: ClassVar[dict[str, int]] = {}

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the folder of the sweep and its sizes."""
        SweepCallback.folder = Path(config.hydra.sweep.dir)
        params = config.hydra.sweeper.get("params") or {}
        words = [f"{name}={values}" for name, values in params.items()]
        loader = GlobalHydra.instance().config_loader()
        values = swept([*words, *config.hydra.overrides.task], loader)
        SweepCallback.sizes = {name: len(several) for name, several in values.items()}
