"""Who may import whom, read from the sources: the ruler knows nothing of what it measures."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.common import ROOT

PACKAGES = ("bench", "methods", "reports", "sweeps")
MAY_IMPORT = {
    "bench": {"bench"},
    "methods": {"bench", "methods"},
    "reports": {"bench", "reports"},
    "sweeps": {"bench", "reports", "sweeps"},
}
REACHES = {
    "sweeps/commands/checks.py": ("methods.checks", "methods.kernels.", "methods.trial."),
    "sweeps/commands/compile.py": ("methods.checks", "methods.kernels."),
    "sweeps/commands/list.py": "methods.kernels.",
}
"""What measures and lists parts of methods reaches them directly; methods only through
`_target_`."""

FIELD = {"kernels", "rendering", "training", "instant_ngp"}
STANDS_ON = {
    "kernels": set(),
    **{name: {"kernels"} for name in ("engines", "rendering", "training")},
    "instant_ngp": {"kernels", "rendering", "training"},
    "gaussians": FIELD,
    "external": {*FIELD, "gaussians"},
    "students": FIELD,
    **{name: {*FIELD, "students"} for name in ("nerf", "nsvf", "kilonerf", "plenoctree", "diver")},
    "steernerf": {*FIELD, "engines"},
}
"""The folders of `methods` from which each may import, beside itself; `methods/checks.py` stands
above them all."""

IMPLEMENTATIONS = {"reference", "cpu", "gpu"}
"""Files of a kernel's folder that the kernel alone knows: all others call its interface."""

SOURCES = sorted(
    path.relative_to(ROOT) for name in PACKAGES for path in (ROOT / name).rglob("*.py")
)


def imports(path: Path) -> Iterator[str]:
    """Every absolute module name imported in a file."""
    tree = ast.parse((ROOT / path).read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_a_module_imports_only_from_packages_below_it(path):
    package = path.parts[0]
    for name in imports(path):
        target = name.split(".")[0]
        if target in PACKAGES and target not in MAY_IMPORT[package]:
            assert str(path) in REACHES, f"{path} imports {name}"
            assert name.startswith(REACHES[str(path)]), f"{path} imports {name}"


METHODS = [path for path in SOURCES if path.parts[0] == "methods" and len(path.parts) > 2]


@pytest.mark.parametrize("path", METHODS, ids=str)
def test_a_method_stands_on_the_floors_below_it(path):
    folder = path.parts[1]
    for name in imports(path):
        package, *rest = name.split(".")
        if package == "methods" and rest[0] != folder:
            assert rest[0] in STANDS_ON[folder], f"{path} imports {name}"


def test_no_floor_stands_on_one_above_it():
    for folder, below in STANDS_ON.items():
        assert all(STANDS_ON[other] < below for other in below), folder


@pytest.mark.parametrize("path", METHODS, ids=str)
def test_an_implementation_of_a_kernel_is_known_to_that_kernel_and_its_like_alone(path):
    """A kernel for the CPU may be made of functions of another one for the CPU."""
    for name in imports(path):
        before, _, kernel = name.partition(".kernels.")
        kernel, *inside = kernel.split(".")
        if IMPLEMENTATIONS & set(inside):
            alike = "kernels" in path.parts and path.stem in inside
            folder = tuple(f"{before}.kernels.{kernel}".split("."))
            assert alike or path.parts[: len(folder)] == folder, f"{path} imports {name}"


@pytest.mark.parametrize(("library", "home"), [("numba", "cpu.py"), ("triton", "gpu.py")])
def test_a_compiler_is_imported_only_by_the_kernels_made_for_it(library, home):
    users = {path for path in SOURCES for name in imports(path) if name.split(".")[0] == library}
    assert {path.name for path in users} <= {home}
    assert all("kernels" in path.parts[1:3] for path in users)


def test_all_machine_code_of_a_cpu_is_kept_as_methods_kernels_cpu_keeps_it():
    """numba's own cache does not look at the files that a function imports from."""
    own = {path for path in SOURCES if {"numba.njit", "numba.jit"} & {*imports(path)}}
    assert own == set()


@pytest.mark.parametrize(("package", "floors"), [("bench", 11), ("sweeps", 6)])
def test_a_package_has_few_floors_and_no_circle(package, floors):
    """A file's floor is one above the highest it imports; a folder is as one file."""
    below = {}
    for path in (path for path in SOURCES if path.parts[0] == package):
        names = {name.split(".")[1] for name in imports(path) if name.startswith(f"{package}.")}
        below.setdefault(path.with_suffix("").parts[1], set()).update(names)

    def floor(file, above=()):
        assert file not in above, f"a circle: {' -> '.join((*above, file))}"
        others = below[file] - {file} & below.keys()
        return 1 + max((floor(other, (*above, file)) for other in others), default=0)

    assert max(map(floor, below)) <= floors


def test_a_class_has_a_name_of_its_own():
    trees = [ast.parse((ROOT / path).read_text(encoding="utf-8")) for path in SOURCES]
    nodes = (node for tree in trees for node in ast.walk(tree))
    names = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []
