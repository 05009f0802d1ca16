"""Choices from installed packages: folders like `sweeps/configs`, named by entry points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import metadata, util
from pathlib import Path

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

GROUP = "steerbench.configs"
"""Group of the entry points; the value of each is the package that holds the YAML files."""


@dataclass(frozen=True)
class PlugIn:
    """The package behind an entry point.

    Attributes:
        name: the entry point and its distribution: "mine (mine-renderers 1.0)".
        folder: contains a folder of YAML files for each group; None: it cannot be used.
        fault: why it cannot be used.
    """

    name: str
    folder: Path | None
    fault: str = ""


@cache
def installed() -> tuple[PlugIn, ...]:
    """All plug-ins of this environment, including unusable ones."""
    entries = sorted(metadata.entry_points(group=GROUP), key=lambda entry: entry.name)
    return tuple(_found(entry) for entry in entries)


def folders() -> list[Path]:
    """The folders of all usable plug-ins."""
    return [each.folder for each in installed() if each.folder]


def _found(entry: metadata.EntryPoint) -> PlugIn:
    name = entry.name
    if entry.dist is not None:
        name = f"{name} ({entry.dist.name} {entry.dist.version})"
    try:
        spec = util.find_spec(entry.value)  # imports the parent packages
    except Exception as error:  # whatever their code raises
        return PlugIn(name, None, f"{type(error).__name__}: {error}")
    if spec is None or not spec.submodule_search_locations:
        return PlugIn(name, None, f"there is no package {entry.value}")
    return PlugIn(name, Path(next(iter(spec.submodule_search_locations))))


class _InstalledChoices(SearchPathPlugin):
    """Appends the plug-ins' folders to Hydra's search path, so that our names take precedence."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in folders():
            search_path.append("steerbench-plug-in", f"file://{folder}")


Plugins.instance().register(_InstalledChoices)
