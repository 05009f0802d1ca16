"""Which files and libraries decide what a class or a function computes, found from the imports.

A cache key holds the digest of these files, so that a change in any of them, and in no other file,
makes new results necessary. No list of files is kept by hand.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from bench.errors import SteerbenchError

ROOT = Path(__file__).resolve().parent.parent
OURS = ("bench", "methods")
WEIGHTS = "*.safetensors"
CHECKS = ("cases.py", "experiments.py")
"""Files of a folder that hold its checks. They compute nothing that a result is made of."""


def digest(*things: Any) -> str:
    """SHA-256 of the names and bytes of the `sources` of `things`.

    Raises:
        SteerbenchError: one of them was changed since its digest was first taken here. This process
            may go on with the old code, whose results would stand under the key of the new one.
    """
    total = hashlib.sha256()
    for name, path in sorted(sources(*things).items()):
        content = _hashed(path, path.stat().st_mtime_ns)
        if _first.setdefault(path, content) != content:
            raise SteerbenchError(f"{name} was changed while this process runs: start it again")
        total.update(f"{name} {content}\n".encode())
    return total.hexdigest()


_first: dict[Path, str] = {}
"""The hash of each file when it was first asked for."""


@cache
def _hashed(path: Path, changed: int) -> str:
    """Of a file as it is since it was `changed`."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def libraries(*things: Any) -> dict[str, str]:
    """The version of every installed distribution that the `sources` of `things` import.

    A class whose libraries are loaded by name lists them in its attribute `libraries`.
    """
    imported = {name for path in sources(*things).values() for name in _imports(path)}
    packages = {name.partition(".")[0] for name in imported} - set(OURS)
    names = {name for package in packages for name in _distributions().get(package, ())}
    names |= {name for thing in things for name in getattr(thing, "libraries", ())}
    versions = ((name, _version(name)) for name in sorted(names))
    return {name: version for name, version in versions if version is not None}


def sources(*things: Any) -> dict[str, Path]:
    """The files that decide what `things`, classes or functions, compute.

    Of this project: the module that each thing is defined in and all that it imports. An imported
    package counts with every file beside its `__init__`, because backends are loaded by name, and
    with the weights that lie there. Of other projects: the whole top-level package of the thing,
    and what that imports of ours and of packages that no installed distribution has.

    Returns:
        Their paths by name, which begins with the top-level package, wherever that lies.
    """
    known = _known.get((ROOT, things))
    if known is None or _times(known[0]) != known[1]:
        found = _found(*things)
        known = _known[ROOT, things] = found, _times(found)
    return known[0]


_known: dict[tuple[Path, tuple[Any, ...]], tuple[dict[str, Path], list[int]]] = {}
"""What `sources` found, and when these files and their folders were changed last: a sweep asks for
the same things again and again."""


def _times(files: dict[str, Path]) -> list[int]:
    places = {*files.values(), *(path.parent for path in files.values())}
    return [path.stat().st_mtime_ns if path.exists() else 0 for path in sorted(places)]


def _found(*things: Any) -> dict[str, Path]:
    found: dict[str, Path] = {}
    seen: set[str] = set()
    pending = {
        name: path for thing in things for name, path in _files(thing.__module__, home=True).items()
    }
    while pending:
        name, path = pending.popitem()
        found[name] = path
        for imported in set(_imports(path)) - seen:
            seen.add(imported)
            files = _files(imported)
            pending |= {name: files[name] for name in files.keys() - found.keys()}
    return found


def _files(name: str, home: bool = False) -> dict[str, Path]:
    """The files of the module or package `name`, or of the one that defines it.

    Where an installed distribution or Python itself has it, its version is enough: none, unless it
    is the `home` of a thing.
    """
    top = name.partition(".")[0]
    if top in OURS:
        return {path.relative_to(ROOT).as_posix(): path for path in _ours(name)}
    if not home and (top in _distributions() or top in sys.stdlib_module_names):
        return {}
    spec = importlib.util.find_spec(top)
    if spec is None:
        return {}
    if spec.submodule_search_locations is None:
        return {Path(str(spec.origin)).name: Path(str(spec.origin))} if spec.has_location else {}
    return {
        path.relative_to(Path(folder).parent).as_posix(): path
        for folder in spec.submodule_search_locations
        for path in Path(folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def _ours(name: str) -> list[Path]:
    """The files of this project that `name` stands for."""
    parts = name.split(".")
    while parts:
        path = ROOT.joinpath(*parts)
        if (path / "__init__.py").exists():
            files = [file for file in path.glob("*.py") if file.name not in CHECKS]
            return files + _weights(path)
        if path.with_suffix(".py").exists():
            return [path.with_suffix(".py"), *_weights(path.parent)]
        parts.pop()
    return []


def _weights(folder: Path) -> list[Path]:
    """Weights below a folder of a top-level package."""
    return list(folder.rglob(WEIGHTS)) if folder.parent != ROOT else []


def _imports(path: Path) -> tuple[str, ...]:
    """The modules, and the names in them, that a file imports anywhere."""
    return _parsed(path, path.stat().st_mtime_ns) if path.suffix == ".py" else ()


@cache
def _parsed(path: Path, changed: int) -> tuple[str, ...]:
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += (f"{node.module}.{alias.name}" for alias in node.names)
    return tuple(names)


@cache
def _distributions() -> dict[str, list[str]]:
    """The distributions that have a top-level package, by its name."""
    return dict(metadata.packages_distributions())


@cache
def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
