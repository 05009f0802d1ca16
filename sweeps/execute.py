"""Runs work where Hydra's launcher puts it: in this process, in others, or on other machines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import InstantiationException
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, open_dict

from sweeps.overrides import CONFIGS, composed, explain, setting
from sweeps.processes import set_up

IN_PROCESS = "basic"
"""Hydra's launcher that runs jobs here, one after the other."""

W = TypeVar("W")
R = TypeVar("R")


@dataclass(frozen=True)
class Launcher:
    """Where work is done.

    Attributes:
        words: the settings of Hydra among those of a command (`hydra/launcher=joblib`), and the
            folders with further choices.
        outputs: the folder of the store; notes on the work go below it.
    """

    words: Sequence[str]
    outputs: Path

    @property
    def in_process(self) -> bool:
        """Whether the work is done by this process."""
        return self._config().hydra.runtime.choices["hydra/launcher"] == IN_PROCESS

    def run(self, work: Callable[[W], R], on: Sequence[W]) -> list[R]:
        """The results of `work` on each of the things in `on`.

        Raises:
            SteerbenchError: a setting of the launcher is wrong.
            Exception: what `work` raised first, once all is done.
        """
        if not on:
            return []
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            loader = GlobalHydra.instance().config_loader()
        config = self._config()
        join_cluster(config)
        try:
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=HydraContext(config_loader=loader, callbacks=Callbacks()),
                task_function=_Numbered(work, on),
                config=config,
            )
        except InstantiationException as error:
            raise explain(error, self.words) from error
        jobs = launcher.launch([[] for _ in on], initial_job_idx=0)
        results = [job.return_value for job in jobs]
        for result in results:
            if isinstance(result, Exception):
                raise result
        return results

    def _config(self) -> DictConfig:
        words = [*self.words, setting("outputs", str(self.outputs))]
        return composed(words, return_hydra_config=True)


def join_cluster(config: DictConfig) -> None:
    """Let Ray's launcher join the cluster at the address in `config`, if there is one.

    It would ask for memory of its own, which a cluster that exists already refuses.
    """
    init = OmegaConf.select(config, "hydra.launcher.ray.init")
    if init and init.get("address"):
        with open_dict(init):
            init.setdefault("object_store_memory", None)


def divided(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The settings of runs among `words`, and those of Hydra."""
    of_hydra = [word for word in words if word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    return [word for word in words if word not in of_hydra], of_hydra


@dataclass(frozen=True)
class _Numbered(Generic[W, R]):
    """The task of a launcher's job: the job's number says what it works on.

    An exception is returned, because Hydra would print it in its own way.
    """

    work: Callable[[W], R]
    on: Sequence[W]

    def __call__(self, config: Any) -> R | Exception:
        set_up()
        try:
            return self.work(self.on[HydraConfig.get().job.num])
        except Exception as error:
            return error
