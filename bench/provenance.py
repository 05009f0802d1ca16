"""Where a result comes from: the files and libraries that computed it, the commit, the machine.

The files that decide what a class or function computes are found from the imports; no list of them
is kept by hand. A cache key holds their digest, so that results become invalid exactly when one of
these files changes.
"""

import ast
import hashlib
import importlib.util
import os
import platform
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from bench.errors import SteerbenchError

ROOT = Path(__file__).resolve().parent.parent
OURS = ("bench", "methods")
CHECKS = ("cases.py", "experiments.py")  # the checks of their folder, which affect no results

CPU_MARKS = ("cpu family", "model", "CPU implementer", "CPU part")
"""Fields of /proc/cpuinfo that tell apart processors which share a name but compute differently."""


@cache
def commit() -> str:
    """The commit of a git checkout, with `-dirty` if changed; otherwise the installed version."""
    try:
        # An installed copy may lie inside a repository that has nothing to do with it.
        _git("ls-files", "--error-unmatch", __file__)
        return _git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return metadata.version("steerbench")


def machine() -> dict[str, object]:
    """The machine and its system, for the record of a run."""
    import torch  # imported here, because reading the store needs no torch

    capabilities = torch.cpu.get_capabilities()
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
        "cuda": torch.version.cuda,
        "system": platform.platform(),
        "python": platform.python_version(),
        "instructions": sorted(name for name, has in capabilities.items() if has is True),
    }


def computed_by(*things: Any) -> dict[str, object]:
    """What decides the results of `things` (classes or functions) beside their inputs, for keys."""
    record = machine()
    return {
        "code": digest(*things),
        "libraries": libraries(*things),
        "machine": {name: record[name] for name in ("cpu", "instructions", "gpus", "python")},
        "threads": record["threads"],
        "kernel_threads": os.environ.get("NUMBA_NUM_THREADS", ""),  # upper limit
    }


def digest(*things: Any) -> str:
    """SHA-256 of the names and bytes of the `sources` of `things`.

    Raises SteerbenchError if a file changed after this process first hashed it: it may still run
    the old code, and would store its results under the key of the new one.
    """
    total = hashlib.sha256()
    for name, path in sorted(sources(*things).items()):
        content = sha256(path)
        if _loaded(path) != content:
            raise SteerbenchError(f"{name} was changed while this process runs: start it again")
        total.update(f"{name} {content}\n".encode())
    return total.hexdigest()


@cache
def _loaded(path: Path) -> str:
    """SHA-256 of a file of code as this process has loaded it: as it was when first asked for."""
    return sha256(path)


def sha256(path: Path) -> str:
    """SHA-256 of a file, read again only if its time of change differs."""
    return _sha256(path, path.stat().st_mtime_ns)


@cache
def _sha256(path: Path, changed: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def libraries(*things: Any) -> dict[str, str]:
    """Versions of all installed distributions that the `sources` of `things` import.

    A class that loads libraries by name lists them in its attribute `libraries`.
    """
    imported = {name for path in sources(*things).values() for name in _imports(path)}
    packages = {name.partition(".")[0] for name in imported} - set(OURS)
    names = {name for package in packages for name in _distributions().get(package, ())}
    names |= {name for thing in things for name in getattr(thing, "libraries", ())}
    versions = {}
    for name in sorted(names):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = _version(name)
    return {name: version for name, version in versions.items() if version}  # of a torn one, None


def sources(*things: Any) -> dict[str, Path]:
    """The files that decide what `things` (classes or functions) compute.

    In this project: the module that defines each thing, and all that it imports, directly or not;
    packages with all files beside their `__init__`, because backends are loaded by name. For a
    thing from another project: its whole top-level package, and what that imports from here or from
    outside any installed distribution. Returns paths by name, which starts at the top-level
    package.
    """
    collected: dict[str, Path] = {}
    seen: set[str] = set()
    pending = {
        name: path for thing in things for name, path in _files(thing.__module__, home=True).items()
    }
    while pending:
        name, path = pending.popitem()
        collected[name] = path
        for imported in set(_imports(path)) - seen:
            seen.add(imported)
            files = _files(imported)
            pending |= {name: files[name] for name in files.keys() - collected.keys()}
    return collected


def _files(name: str, home: bool = False) -> dict[str, Path]:
    """The files of the module or package `name`, or of the module that defines that name.

    Empty for installed distributions and Python itself, whose versions are enough, unless it is the
    `home` of a thing.
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
    path = ROOT.joinpath(*name.split("."))
    while path != ROOT:
        if (path / "__init__.py").exists():
            return [file for file in path.glob("*.py") if file.name not in CHECKS]
        if path.with_suffix(".py").exists():
            return [path.with_suffix(".py")]
        path = path.parent
    return []


def _imports(path: Path) -> tuple[str, ...]:
    """The modules, and names from modules, that a file imports anywhere in its code."""
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


_version = cache(metadata.version)  # of a distribution
_distributions = cache(metadata.packages_distributions)  # that provide each top-level package


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _cpu_model() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor()
    # The first processor stands for all of them.
    known = {k.strip(): v.strip() for k, _, v in (x.partition(":") for x in text.splitlines()[:40])}
    marks = [f"{mark.removeprefix('cpu ')} {known[mark]}" for mark in CPU_MARKS if mark in known]
    name = known.get("model name", platform.machine())
    return f"{name} ({', '.join(marks)})" if marks else name
