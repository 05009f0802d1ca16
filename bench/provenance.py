"""Where a result comes from: the files and libraries that computed it, the commit, the machine.

The files that decide what a class or function computes are found from the imports; no list of them
is kept by hand. A cache key holds their digest, so that results become invalid exactly when one of
these files changes.
"""

import ast
import hashlib
import importlib.util
import marshal
import os
import platform
import re
import struct
import subprocess
import sys
import sysconfig
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

from bench.errors import SteerbenchError, unexpected
from bench.records import without

Stamp = tuple[int, ...]  # of a file, see `stamp`

ROOT = Path(__file__).resolve().parent.parent
OURS = ("bench", "methods")
STDLIB = {Path(sysconfig.get_paths()[name]) for name in ("stdlib", "platstdlib")}
INSTALLED = {"site-packages", "dist-packages"}
LEFT_OUT = re.compile(r"(^|/)(\.[^/]|__pycache__)")  # hidden, or what Python compiles
CHECKS = ("cases.py", "experiments.py")  # the checks of their folder, which affect no results

TUNING = re.compile(
    "(ATEN|CUBLAS|CUDA|CUDNN|DNNL|GOMP|KMP|MALLOC|MKL|NUMBA|NVIDIA|OMP|ONEDNN|OPENBLAS|OV|PYTORCH"
    r"|TORCH|TRITON)_(?!\w*(CACHE|DIR|HOME|PATH))|LD_PRELOAD$|THP_MEM_ALLOC_ENABLE$"
)
"""Variables that change how fast libraries compute, or what; not those that name their folders."""

OF_TIMES = (
    *("CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
    *("OMP_PROC_BIND", "OMP_PLACES", "KMP_AFFINITY", "GOMP_SPINCOUNT", "THP_MEM_ALLOC_ENABLE"),
)
"""Those that change times alone, or results by what a key holds anyway: GPUs, threads."""

CPU_MARKS = ("cpu family", "model", "CPU implementer", "CPU part")
"""Fields of /proc/cpuinfo that tell apart processors which share a name but compute differently."""


@cache
def commit() -> str:
    """The commit of a git checkout, with `-dirty` if changed; otherwise the installed version."""
    return _commit_of(Path(__file__)) or metadata.version("steerbench")


def repositories(*things: Any) -> dict[str, str]:
    """The commits of the git checkouts that files of others among the `sources` of `things` lie in,
    with `-dirty` if changed, by their top-level package."""
    first = {name.partition("/")[0]: path for name, path in sorted(sources(*things).items())}
    commits = {top: _commit_of(path) for top, path in first.items() if top not in OURS}
    return {top: of for top, of in commits.items() if of}


def _commit_of(file: Path) -> str | None:
    """The commit of the checkout that has this `file`; None of a file that git does not know: an
    installed copy may lie inside a repository that has nothing to do with it."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(file.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", str(file))
        return git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


def machine() -> Mapping[str, object]:
    """The machine and its system, for the record of a run."""
    import torch  # imported here, because reading the store needs no torch

    capabilities = torch.cpu.get_capabilities()
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "affinity": len(os.sched_getaffinity(0)),
        "environment": _tuning(),
        "threads": torch.get_num_threads(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
        "cuda": torch.version.cuda,
        "system": platform.platform(),
        "python": platform.python_version(),
        "instructions": sorted(name for name, has in capabilities.items() if has is True),
    }


def computed_by(*things: Any) -> Mapping[str, object]:
    """What decides the results of `things` (classes or functions) beside their inputs, for keys."""
    record = machine()
    return {
        "code": digest(*things),
        "libraries": libraries(*things),
        "machine": {name: record[name] for name in ("cpu", "instructions", "gpus", "python")},
        "threads": record["threads"],
        "environment": without(_tuning(), OF_TIMES),
    }


def _tuning() -> dict[str, str]:
    return {name: of for name, of in sorted(os.environ.items()) if TUNING.match(name)}


def conditions_apart(then: Mapping[str, Any]) -> str:
    """What may change times since a run with `then` as record of its machine, although it changes
    no result; empty if nothing."""
    cores = len(os.sched_getaffinity(0))
    before = {"cores": then.get("affinity", cores), **then.get("environment", {})}
    now = {"cores": cores, **_tuning()}
    names = [name for name in before | now if before.get(name) != now.get(name)]
    return ", ".join(f"{name}: {before.get(name)}, now {now.get(name)}" for name in names)


def digest(*things: Any) -> str:
    """SHA-256 of the names and the content of the `sources` of `things`: of Python what it
    computes, whatever its comments and docstrings, of other files their bytes.

    Raises SteerbenchError if a file changed after this process first hashed it, or loaded it: it
    may still run the old code, and would store its results under the key of the new one.
    """
    total, files = hashlib.sha256(), sorted(sources(*things).items())
    of_others = [path for name, path in files if name.partition("/")[0] not in OURS]
    documented = any(_module(path, stamp(path)).documented for path in of_others)
    for name, path in files:
        content = code_sha256(path)
        other = path in of_others
        if _loaded(path) != content or (other and not is_as_loaded(path)):
            raise SteerbenchError(f"{name} was changed while this process runs: start it again")
        if other and documented:  # one may read the docstrings of another
            content = sha256(path)
        total.update(f"{name} {content}\n".encode())
    return total.hexdigest()


@cache
def _loaded(path: Path) -> str:
    """`code_sha256` of a file as this process has loaded it: as it was when first asked for."""
    return code_sha256(path)


def sha256(path: Path) -> str:
    """SHA-256 of a file, read again only if it has changed."""
    return _sha256(path, stamp(path))


def code_sha256(path: Path) -> str:
    """SHA-256 of what a file of Python computes; of another file, as `sha256`."""
    return _module(path, stamp(path)).sha256 if path.suffix == ".py" else sha256(path)


def sums_of(places: Iterable[Path], where: str) -> list[str]:
    """The checksums of files, and of all files below folders; SteerbenchError if one of `places` is
    not there."""
    found: set[Path] = set()
    for place in places:
        if not place.exists():
            raise unexpected(where, "files and folders", f"{place}, which is not there")
        found |= set(files_at(place))
    return sorted(code_sha256(file) for file in found)


def stamp(path: Path) -> Stamp:
    """Times, size and number of a file: they change whenever its content does."""
    now = path.stat()
    return now.st_mtime_ns, now.st_ctime_ns, now.st_size, now.st_ino


@cache
def _sha256(path: Path, stamp: Stamp) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class _Module(NamedTuple):
    """What is known of a file of Python: the modules, and names from modules, that it imports
    anywhere in its code; SHA-256 of its syntax tree; whether it reads docstrings."""

    imports: Sequence[str]
    sha256: str
    documented: bool = False


@cache
def _module(path: Path, stamp: Stamp) -> _Module:
    content = path.read_bytes()
    in_bytes = hashlib.sha256(content).hexdigest()
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError):  # a template, or of another version of Python
        return _Module((), in_bytes)
    imports: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            imports += (f"{node.module}.{alias.name}" for alias in node.names)
    parts: list[str] = []
    documented = b"__doc__" in content or b"getdoc" in content
    try:
        _write_tree(tree, parts, documented)
    except RecursionError:  # a sum of a thousand terms
        return _Module(tuple(imports), in_bytes, documented)
    computed = hashlib.sha256("".join(parts).encode()).hexdigest()
    return _Module(tuple(imports), computed, documented)


UNREAD = ("ctx", "kind", "type_comment", "type_ignores")  # fields that change nothing


def _write_tree(node: object, parts: list[str], documented: bool) -> None:
    """Append a syntax tree as text, without positions and, unless code reads what is `documented`,
    without docstrings: the same in all versions of Python that parse it alike."""
    if isinstance(node, list):
        parts.append("[")
        for each in node:
            if documented or not _is_text(each):
                _write_tree(each, parts, documented)
        parts.append("]")
    elif isinstance(node, ast.AST):
        parts.append(f"{type(node).__name__}(")
        for name in node._fields:
            value = getattr(node, name, None)
            if name not in UNREAD and value not in (None, []):
                parts.append(f"{name}=")
                _write_tree(value, parts, documented)
        parts.append(")")
    else:
        parts.append(f"{node!r},")


def _is_text(node: object) -> bool:
    """Whether a statement is a text alone, as docstrings are."""
    alone = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return alone and isinstance(node.value.value, str)  # type: ignore[attr-defined]


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
    pending: dict[str, Path] = {}
    for thing in things:
        own = _files(thing.__module__, home=True)
        if not own and thing.__module__ not in sys.stdlib_module_names:
            in_a_file = "a class or function in a file, whose code a key can hold"
            raise unexpected(thing.__module__, in_a_file, thing.__qualname__)
        pending |= own
    while pending:
        name, path = pending.popitem()
        collected[name] = path
        for imported in set(_imports(path)) - seen:
            seen.add(imported)
            files = _files(imported)
            pending |= {name: files[name] for name in files.keys() - collected.keys()}
    return collected


def check_unchanged(loaded: Collection[str], *things: Any) -> None:
    """Raise SteerbenchError if results since `loaded` were the names of all modules may come from
    code that the key of `things` does not hold: a file was changed, or a module is used that is not
    among their `sources`, because it was imported later, or by a name that is made by the code.

    Modules that came later are forgotten, so that another run has to import them again, and is
    refused, too.
    """
    digest(*things)
    files = sources(*things)
    known = {path.resolve() for path in files.values()}
    ours = [ROOT / top for top in (*OURS, "reports", "sweeps")]

    def foreign(names: Iterable[str]) -> Iterator[str]:
        for name in names:
            file = getattr(sys.modules.get(name), "__file__", None)
            path = Path(file or "").resolve()
            if is_edited(file) and path not in known and not set(path.parents).intersection(ours):
                yield name

    late = sorted(foreign(sys.modules.keys() - loaded))
    modules = _modules_of_others(files)
    used = sorted(foreign(_used_by(modules)))
    unknown = [*late, *used]
    if changed := _patched(modules):
        raise SteerbenchError(f"{changed} was replaced by code that no key holds: start again")
    if unknown:
        file = sys.modules[unknown[0]].__file__
        for name in late:
            del sys.modules[name]
        raise SteerbenchError(
            f"{unknown[0]} was imported while the run went on, or by a name that is made by the "
            f"code, so its key does not hold {file}: import it at the top of a file of the method, "
            "and run again"
        )


def _modules_of_others(files: Mapping[str, Path]) -> list[ModuleType]:
    """The loaded modules of others among `sources`."""
    others = {str(path) for name, path in files.items() if name.partition("/")[0] not in OURS}
    loaded = list(sys.modules.values())
    return [module for module in loaded if getattr(module, "__file__", None) in others]


def _used_by(modules: Iterable[ModuleType]) -> set[str]:
    """The names of the modules whose things `modules` have as global names."""
    names: set[str] = set()
    for module in modules:
        for thing in vars(module).values():
            name = thing.__name__ if isinstance(thing, ModuleType) else None
            names.add(str(name or getattr(thing, "__module__", None)))
    return names - {"__main__"}


FIRST_SEEN: WeakKeyDictionary[ModuleType, dict[str, object]] = WeakKeyDictionary()
"""What modules of others and their classes held when this process first used them."""


def left_behind(*things: Any) -> list[str]:
    """What modules and classes of others among the `sources` of `things` hold that is not as this
    process found it: a run before has left it there, where it may change this one."""
    found: list[str] = []
    for module in _modules_of_others(sources(*things)):
        now = _state_of(module, module.__name__)
        then = FIRST_SEEN.setdefault(module, now)
        found += (name for name in now | then if now.get(name) != then.get(name))
    return sorted(found)


def _state_of(owner: Any, place: str) -> dict[str, object]:
    """Which things, of which length, a module and its classes hold; of functions, how many results
    they remember."""
    held: dict[str, object] = {}
    for name, value in vars(owner).items():
        inside = f"{place}.{name}"
        own = getattr(value, "__module__", None) == getattr(owner, "__module__", place)
        if name.startswith("__") or isinstance(value, ModuleType):
            continue
        if isinstance(value, type):
            held |= _state_of(value, inside) if own and isinstance(owner, ModuleType) else {}
        elif hasattr(value, "cache_info"):
            held[inside] = value.cache_info().currsize
        elif not callable(value):
            held[inside] = id(value), len(value) if isinstance(value, Sized) else None
    return held


def _patched(modules: Iterable[ModuleType]) -> str:
    """The name of a method, of a class in `modules`, whose function a notebook or a script made."""
    for module in modules:
        for name, thing in vars(module).items():
            members = vars(thing) if isinstance(thing, type) else {}
            for member, value in members.items():
                if isinstance(value, FunctionType) and value.__module__ == "__main__":
                    return f"{name}.{member}"
    return ""


def is_as_loaded(path: Path) -> bool:
    """Whether the module in a file, if it is loaded, is that of the present content: Python runs
    what it compiled from a file of the same time and size, or what it loaded before an edit."""
    compiled = Path(importlib.util.cache_from_source(str(path)))
    files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
    if str(path) not in files or not compiled.is_file():
        return True
    return _is_compiled(path, compiled, stamp(path), stamp(compiled))


@cache
def _is_compiled(path: Path, compiled: Path, *stamps: Stamp) -> bool:
    """Whether what Python has `compiled` of a file is what the file holds."""
    content = compiled.read_bytes()
    flags, time, size = struct.unpack("<4xIII", content[:16])
    now = path.stat()
    if not flags and (time, size) != (int(now.st_mtime) & 0xFFFFFFFF, now.st_size & 0xFFFFFFFF):
        return False
    try:
        present = compile(path.read_bytes(), str(path), "exec", dont_inherit=True)
    except (SyntaxError, ValueError):
        return False
    return _alike(marshal.loads(content[16:]), present)


def _alike(one: CodeType, other: CodeType) -> bool:
    """Whether two codes compute the same, wherever their lines stand."""
    names = ("co_code", "co_names", "co_varnames", "co_freevars", "co_cellvars", "co_argcount")
    if any(getattr(one, name) != getattr(other, name) for name in names):
        return False
    pairs = list(zip(one.co_consts, other.co_consts, strict=False))
    return len(one.co_consts) == len(other.co_consts) and all(
        _alike(a, b) if isinstance(a, CodeType) and isinstance(b, CodeType) else repr(a) == repr(b)
        for a, b in pairs
    )


def _files(name: str, home: bool = False) -> dict[str, Path]:
    """The files of the module or package `name`, or of the module that defines that name.

    Empty for installed distributions and Python itself, whose versions are enough, unless it is the
    `home` of a thing, or was installed so that it can be edited.
    """
    top = name.partition(".")[0]
    if top in OURS:
        return {path.relative_to(ROOT).as_posix(): path for path in _ours(name)}
    if not home and top in sys.stdlib_module_names:
        return {}
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):  # one that was made while the process runs
        return {}
    if spec is None:
        return {}
    place = spec.origin or next(iter(spec.submodule_search_locations or ()), None)
    if not home and not is_edited(place):
        return {}
    if spec.submodule_search_locations is None:
        return {Path(str(spec.origin)).name: Path(str(spec.origin))} if spec.has_location else {}
    return {
        path.relative_to(folder.parent).as_posix(): path
        for folder in map(Path, spec.submodule_search_locations)
        for path in files_at(folder)
    }


def files_at(place: Path) -> list[Path]:
    """A file, or all files below a folder, also behind links, but for hidden ones and what Python
    compiles."""
    if place.is_file():
        return [place]
    found: list[Path] = []
    seen: set[str] = set()
    for folder, folders, names in os.walk(place, followlinks=True):
        real = os.path.realpath(folder)
        if real in seen:  # a link to a folder above it
            folders.clear()
            continue
        seen.add(real)
        found += (Path(folder, name) for name in names)
    return [
        file
        for file in found
        if file.is_file() and not LEFT_OUT.search(file.relative_to(place).as_posix())
    ]


def is_edited(file: str | None) -> bool:
    """Whether a module at `file` may change under one version: it lies neither in Python itself nor
    where packages are installed."""
    place = Path(file or "built-in")
    installed = INSTALLED.intersection(place.parts) or STDLIB.intersection(place.parents)
    return place.is_absolute() and not installed


def _ours(name: str) -> list[Path]:
    path = ROOT.joinpath(*name.split("."))
    while path != ROOT:
        if (path / "__init__.py").exists():
            return [file for file in path.glob("*.py") if file.name not in CHECKS]
        if path.with_suffix(".py").exists():
            return [path.with_suffix(".py")]
        path = path.parent
    return []


def _imports(path: Path) -> Sequence[str]:
    return _module(path, stamp(path)).imports if path.suffix == ".py" else ()


@cache
def _version(name: str) -> str:
    """The version of a distribution; of one that was installed from a folder or a file of one's
    own, which may change under its version, with a checksum of what was installed."""
    found = metadata.distribution(name)
    if found.read_text("direct_url.json") is None:
        return found.version
    installed = hashlib.sha256((found.read_text("RECORD") or "").encode()).hexdigest()
    return f"{found.version}+{installed[:12]}"


_distributions = cache(metadata.packages_distributions)  # that provide each top-level package


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
