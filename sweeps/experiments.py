"""Reads the files of experiments: what they vary, and which axes of a method that makes."""

from typing import Any

from bench.errors import SteerbenchError, unknown
from bench.kinds import Words
from bench.study import Axis
from sweeps.overrides import choices, loaded, taken

SEED = "seed"  # in a grid, it makes no lines: they are means over their seeds


def experiment(name: str, words: Words = ()) -> Any:
    """What the file of an experiment holds; `words` may name folders with further ones."""
    files = choices("experiment", words)
    if name not in files:
        tables = [each for each, file in files.items() if "table" in loaded(file)]
        error = unknown("table", name, tables)
        raise SteerbenchError(f"{error} --config-dir DIR names a folder with further ones")
    return loaded(files[name]) or {}


def grid(declared: Any) -> dict[str, list[str]]:
    """The settings that an experiment varies, each with its values, by what its file holds."""
    params = declared.get("hydra", {}).get("sweeper", {}).get("params") or {}
    words = [f"{name}={values}" for name, values in params.items()]
    return {name: taken(words, name)[1] for name in params}


def axes(method: str) -> dict[str, Axis]:
    """The settings of `method`, whole numbers, that our tables vary, by the name of the axis."""
    found = {}
    for name in choices("experiment"):
        declared = experiment(name)
        table, methods = declared.get("table") or {}, declared.get("defaults") or ()
        if "axis" not in table or {"override /method": method} not in methods:
            continue
        for setting, values in grid(declared).items():
            if setting != SEED and all(map(str.isdecimal, values)):
                symbol, sizes = table["axis"], tuple(sorted(map(int, values)))
                label = table.get("label", f"{symbol} = {{}}")
                found[symbol] = Axis(label, setting, sizes)
                break
    return found
