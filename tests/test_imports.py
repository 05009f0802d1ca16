"""Who may import whom, read from the sources: the ruler knows nothing of what it measures."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("bench", "methods", "reports", "sweeps")
MAY_IMPORT = {
    "bench": {"bench"},
    "methods": {"bench", "methods"},
    "reports": {"bench", "reports"},
    "sweeps": {"bench", "reports", "sweeps"},
}
REACHES = {
    "sweeps/accuracy.py": "methods.checks.",
    "sweeps/kernels.py": ("methods.checks.", "methods.kernels."),
    "sweeps/catalogue.py": "methods.kernels.",
    "sweeps/stress.py": "methods.checks.",
}
"""What measures and lists parts of methods reaches them directly; methods only through
`_target_`."""

SOURCES = sorted(
    path.relative_to(ROOT) for name in PACKAGES for path in (ROOT / name).rglob("*.py")
)


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Every absolute module name imported in a file, and whether at the top of the module."""
    tree = ast.parse((ROOT / path).read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node in tree.body) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from ((f"{node.module}.{alias.name}", node in tree.body) for alias in node.names)


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_a_module_imports_only_from_packages_below_it(path):
    package = path.parts[0]
    for name, _ in imports(path):
        target = name.split(".")[0]
        if target in PACKAGES and target not in MAY_IMPORT[package]:
            assert str(path) in REACHES, f"{path} imports {name}"
            assert name.startswith(REACHES[str(path)]), f"{path} imports {name}"


@pytest.mark.parametrize(("library", "home"), [("numba", "cpu.py"), ("triton", "gpu.py")])
def test_a_compiler_is_imported_only_by_the_kernels_made_for_it(library, home):
    users = {path for path in SOURCES for name, _ in imports(path) if name.split(".")[0] == library}
    assert {path.name for path in users} <= {home}
    assert {path.parts[:2] for path in users} <= {("methods", "kernels")}


def test_the_command_line_opens_without_loading_torch():
    """Help and completion answer at once because nothing they need imports torch."""
    seen, pending = set(), {Path("sweeps/cli.py"), Path("sweeps/run.py")}
    while pending:
        path = pending.pop()
        seen.add(path)
        for name, at_top in imports(path):
            if at_top:
                assert name.split(".")[0] != "torch", f"{path} imports {name}"
                module = Path(*name.split("."))  # or a name in a module
                pending |= {Path(f"{module}.py"), Path(f"{module.parent}.py")} & set(SOURCES) - seen
