"""Which files and libraries decide what a class or a function computes, found from the imports.

A cache key holds the digest of these files, so that a change in any of them, and in no other file,
asks for new results. Nobody keeps a list of files by hand.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
OURS = ("bench", "methods")
DATA = ("*.safetensors",)
CHECKS = ("cases.py", "experiments.py")
"""Files of a folder that hold its checks. They compute nothing that a result is made of."""


def digest(*things: Any) -> str:
    """SHA-256 of the paths and bytes of the `sources` of `things`."""
    total = hashlib.sha256()
    for name, path in sorted((_name(path), path) for path in sources(*things)):
        content = path.read_bytes()
        total.update(f"{name} {len(content)}\n".encode())
        total.update(content)
    return total.hexdigest()


def libraries(*things: Any) -> dict[str, str]:
    """The version of every distribution that the `sources` of `things` import.

    A class whose libraries are loaded by name lists them in its attribute `libraries`.
    """
    names = {name for path in sources(*things) for name in _imports(path)}
    distributions = {
        distribution
        for name in {name.partition(".")[0] for name in names} - set(OURS)
        for distribution in _distributions().get(name, ())
    }
    distributions |= {name for thing in things for name in getattr(thing, "libraries", ())}
    found = ((name, _version(name)) for name in sorted(distributions))
    return {name: version for name, version in found if version is not None}


def sources(*things: Any) -> frozenset[Path]:
    """The files that decide what `things`, classes or functions, compute.

    Of this project: the module that each thing is defined in and all that it imports. An imported
    package counts with every file beside its `__init__`, because backends are loaded by name. Of
    other projects: the whole top-level package of the thing, and what of ours it imports.
    """
    found: set[Path] = set()
    pending = {path for thing in things for path in _home(thing.__module__)}
    while pending:
        path = pending.pop()
        found.add(path)
        for name in _imports(path):
            pending |= set(_ours(name)) - found
    return frozenset(found | {data for path in found for data in _data(path)})


def _home(module: str) -> list[Path]:
    """The files that stand for the module a thing is defined in."""
    top = module.partition(".")[0]
    if top in OURS:
        return _ours(module)
    spec = importlib.util.find_spec(top)
    if spec is None or spec.origin in (None, "built-in", "frozen"):
        return []
    if spec.submodule_search_locations is None:
        return [Path(str(spec.origin))]
    folders = map(Path, spec.submodule_search_locations)
    files = (path for folder in folders for path in folder.rglob("*") if path.is_file())
    return [path for path in files if "__pycache__" not in path.parts]


def _ours(name: str) -> list[Path]:
    """The files of the module or package `name` of this project, or of the one that defines it."""
    parts = name.split(".")
    while parts and parts[0] in OURS:
        path = ROOT.joinpath(*parts)
        if (path / "__init__.py").exists():
            return [file for file in path.glob("*.py") if file.name not in CHECKS]
        if path.with_suffix(".py").exists():
            return [path.with_suffix(".py")]
        parts.pop()
    return []


def _imports(path: Path) -> Iterable[str]:
    """The modules, and the names in them, that a file imports anywhere."""
    return _parsed(path, path.stat().st_mtime_ns) if path.suffix == ".py" else ()


@cache
def _parsed(path: Path, changed: int) -> tuple[str, ...]:
    return tuple(_imported(ast.parse(path.read_text(encoding="utf-8"))))


def _imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _data(path: Path) -> Iterator[Path]:
    """Weights that lie below the folder of a source file of this project."""
    if path.is_relative_to(ROOT) and path.parent.parent != ROOT:
        for kind in DATA:
            yield from path.parent.rglob(kind)


def _name(path: Path) -> str:
    """A path as it stands in a digest: it does not depend on where a project is installed."""
    base = path.parent
    while (base / "__init__.py").exists():
        base = base.parent
    return path.relative_to(base).as_posix()


@cache
def _distributions() -> dict[str, list[str]]:
    return dict(metadata.packages_distributions())


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
