"""What Hydra tells of a sweep before its first job, in the process that began it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from hydra.core.global_hydra import GlobalHydra
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from sweeps.overrides import swept


class Announced(Callback):
    """The sweep that is under way; run.yaml names it among Hydra's callbacks.

    Hydra makes the object itself and hands it to nobody, so what it hears is kept on the class.

    Attributes:
        folder: where the jobs leave how they ended; None where there is no sweep.
        sizes: how many values each setting takes that takes several in turn.
    """

    folder: ClassVar[Path | None] = None
    sizes: ClassVar[dict[str, int]] = {}

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Keep where the sweep lies and how large it is."""
        Announced.folder = Path(config.hydra.sweep.dir)
        params = config.hydra.sweeper.get("params") or {}
        lines = [f"{name}={values}" for name, values in params.items()]
        loader = GlobalHydra.instance().config_loader()
        values = swept([*lines, *config.hydra.overrides.task], loader)
        Announced.sizes = {name: len(several) for name, several in values.items()}
