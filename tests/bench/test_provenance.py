"""The digest of a thing follows the files it stands on; commit and machine are as they are."""

import importlib
import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import torch

from bench import provenance
from bench.errors import SteerbenchError
from bench.measure import measure
from bench.provenance import computed_by, libraries, repositories
from methods.instant_ngp.stage1 import train_field

commit = provenance.commit.__wrapped__
MACHINE = provenance.machine()


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=test", "-c", "user.email=test@example.org")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_a_checkout_names_its_commit_and_whether_it_was_changed(tree):
    git(tree, "init", "-q")
    git(tree, "add", ".")
    git(tree, "commit", "-q", "-m", "first")
    head = git(tree, "rev-parse", "--short=12", "HEAD")
    assert commit() == head
    (tree / "methods/fields/cpu.py").write_text("A = 2\n")
    assert commit() == f"{head}-dirty"


def test_the_checkout_of_a_package_of_others_is_named(tree, tmp_path, monkeypatch):
    theirs = tmp_path / "theirs"
    write(theirs, {"odd/__init__.py": "", "odd/method.py": "A = 1\n"})
    monkeypatch.syspath_prepend(theirs)
    assert repositories(defined_in("odd.method"), METHOD) == {}
    git(theirs, "init", "-q")
    git(theirs, "add", ".")
    git(theirs, "commit", "-q", "-m", "first")
    head = git(theirs, "rev-parse", "--short=12", "HEAD")
    assert repositories(defined_in("odd.method"), METHOD) == {"odd": head}
    write(theirs, {"odd/method.py": "A = 2\n"})
    assert repositories(defined_in("odd.method"), METHOD) == {"odd": f"{head}-dirty"}


def test_without_git_or_in_another_repository_the_version_is_named(tree, monkeypatch):
    git(tree, "init", "-q")
    git(tree, "add", "methods")
    git(tree, "commit", "-q", "-m", "a project that has steerbench in its .venv")
    assert commit() == metadata.version("steerbench")
    monkeypatch.setenv("PATH", "")
    assert commit() == metadata.version("steerbench")


def test_the_machine_record_names_what_matters():
    assert MACHINE["memory_bytes"] > 1 << 28
    assert MACHINE["cpu"]
    assert len(MACHINE["gpus"]) == torch.cuda.device_count()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("cpu family\t: 25\nmodel\t: 1\nmodel name\t: EPYC\n", "EPYC (family 25, model 1)"),
        ("CPU implementer\t: 0x41\nCPU part\t: 0xd40\n", "(CPU implementer 0x41, CPU part 0xd40)"),
    ],
)
def test_processors_of_one_name_are_distinguished(text, name, monkeypatch):
    monkeypatch.setattr(Path, "read_text", lambda path, *more, **options: text)
    assert provenance.machine()["cpu"].endswith(name)


FILES = {
    "bench/ruler.py": "",
    "bench/unused.py": "A = 1\n",
    "methods/__init__.py": "",
    "methods/fields/__init__.py": "import importlib\n",
    "methods/fields/cpu.py": "from bench import ruler\nimport numpy.linalg\n",
    "methods/fields/cases.py": "import scipy\n",
    "methods/fields/experiments.py": "import scipy\n",
    "methods/alone/__init__.py": "",
    "methods/alone/beside.py": "",
    "methods/alone/method.py": "def fit():\n    from methods.fields import field\n",
}


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def defined_in(module: str, **attributes: Any) -> type:
    return type("Thing", (), {"__module__": module, **attributes})


def digest(*things: Any) -> str:
    """As a process finds it that has just begun."""
    provenance._loaded.cache_clear()
    return provenance.digest(*things)


METHOD = defined_in("methods.alone.method")


@pytest.fixture
def tree(tmp_path, monkeypatch) -> Path:
    """A small project: a method in a module that imports a package of fields."""
    write(tmp_path / "here", FILES)
    monkeypatch.setattr(provenance, "ROOT", tmp_path / "here")
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "here/bench/ruler.py"))
    return tmp_path / "here"


def test_a_file_that_is_changed_while_a_process_runs_ends_it(tree):
    """Its old code, still loaded, would store its results under the key of the new one."""
    before = digest(METHOD)
    (tree / "bench/ruler.py").write_text("A = 2\n")
    with pytest.raises(SteerbenchError, match=r"bench/ruler\.py was changed while this process"):
        provenance.digest(METHOD)
    write(tree, FILES)
    assert provenance.digest(METHOD) == before


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("methods/alone/method.py", True),
        ("methods/fields/__init__.py", True),
        ("methods/fields/cpu.py", True),
        ("methods/fields/gpu.py", True),  # a new file beside an imported package
        ("bench/ruler.py", True),
        ("bench/unused.py", False),
        ("methods/__init__.py", False),
        ("methods/alone/beside.py", False),
        ("methods/fields/cases.py", False),
        ("methods/fields/experiments.py", False),
        ("methods/fields/__pycache__/cpu.pyc", False),
    ],
)
def test_what_a_thing_stands_on_changes_its_digest_and_nothing_else(tree, name, counts):
    before = digest(METHOD)
    assert digest(METHOD) == before
    write(tree, {name: FILES.get(name, "") + "B = 1\n"})
    assert (digest(METHOD) != before) == counts


PLAIN = """
import math

WIDTH = 3


def area(side):
    return math.pi * side * f"{side!r:>{WIDTH}}"
"""
DOCUMENTED = '''"""A module, now with words."""
import math  # not numpy

WIDTH = 3
"""Of a text."""


def area(
    side,
):
    """What it is."""
    # Long lines
    # are no other code.

    return math.pi * side * f"{side!r:>{WIDTH}}"
'''


def test_comments_docstrings_and_layout_are_free_and_all_that_computes_counts(tree):
    def of(text: str) -> str:
        write(tree, {"bench/ruler.py": text})
        return digest(METHOD)

    before = of(PLAIN)
    assert of(DOCUMENTED) == before
    changes = {"= 3": "= 4", "math.pi": "math.e", "area": "Area", "!r": "!s", "side *": "side /"}
    assert len({of(PLAIN.replace(*change)) for change in changes.items()} | {before}) == 6
    assert of(PLAIN.replace("WIDTH = 3", "WIDTH = 3.0")) != before
    assert of(PLAIN.replace("WIDTH = 3", 'WIDTH = "3"')) != before
    # Here the words are read, by a program.
    read = [of(text + "print(__doc__)\n") for text in (PLAIN, DOCUMENTED)]
    assert read[0] != read[1]
    assert of("print 3\n") != of("print 4\n")  # of Python 2
    long = f"import {{}}\nA = {' + '.join(['1'] * 2000)}\n"
    assert of(long.format("math")) != of(long.format("cmath"))  # too deep to be written as a tree


def test_a_comment_may_be_written_while_a_process_runs(tree):
    before = digest(METHOD)
    write(tree, {"bench/ruler.py": "# why\n"})
    assert provenance.digest(METHOD) == before


def test_code_that_is_in_no_file_has_no_key():
    with pytest.raises(SteerbenchError, match="nowhere: expected a class or function in a file"):
        digest(defined_in("nowhere"))


def test_the_digest_depends_on_names_but_not_on_where_the_project_lies_nor_on_an_order(
    tree, monkeypatch
):
    before, ruler = digest(METHOD), defined_in("bench.ruler")
    assert digest(METHOD, ruler) == digest(ruler, METHOD) == before != digest(ruler)
    shutil.move(tree, tree.with_name("there"))
    monkeypatch.setattr(provenance, "ROOT", tree.with_name("there"))
    assert digest(METHOD) == before
    fields = tree.with_name("there") / "methods/fields"
    (fields / "cpu.py").rename(fields / "cuda.py")
    assert digest(METHOD) != before


PLUGIN = {
    "foreign_{}/__init__.py": "",
    "foreign_{}/method.py": "from bench import ruler\nfrom foreign_{0} import helper\n",
    "foreign_{}/helper.py": "A = 1\n",
    "foreign_{}/data/table.bin": "5",
    "other_{}/__init__.py": "",
}


@pytest.fixture(params=["package", "namespace"])
def plugin(request, tree, tmp_path, monkeypatch) -> tuple[Path, type]:
    """A method of another project in a package of two modules, with or without an `__init__`."""
    files = {name.format(request.param): text for name, text in PLUGIN.items()}
    write(tmp_path / "site", {name: text.format(request.param) for name, text in files.items()})
    folder = tmp_path / "site" / f"foreign_{request.param}"
    if request.param == "namespace":
        (folder / "__init__.py").unlink()
    monkeypatch.syspath_prepend(tmp_path / "site")
    return folder, defined_in(f"foreign_{request.param}.method")


def test_all_of_a_plugin_and_what_it_imports_of_ours_count_and_not_where_it_lies(
    plugin, tree, monkeypatch
):
    folder, thing = plugin
    before = digest(thing)
    write(tree, {"bench/unused.py": "B = 1\n"})
    write(folder.parent, {"beside.py": "", f"{folder.name}/__pycache__/helper.pyc": ""})
    assert digest(thing) == before
    write(tree, {"bench/ruler.py": "B = 1\n"})
    assert digest(thing) != before
    before = digest(thing)
    elsewhere = folder.parent.with_name("elsewhere")
    shutil.move(folder.parent, elsewhere)
    monkeypatch.syspath_prepend(elsewhere)
    assert digest(thing) == before
    for name in ("helper.py", "data/table.bin", "method.py"):
        before = digest(thing)
        (elsewhere / folder.name / name).write_text("A = 2\n")
        assert digest(thing) != before


@pytest.mark.parametrize("place", ["site-packages", "src"])
def test_a_package_counts_by_its_version_where_packages_are_installed_and_else_by_its_files(
    place, tree, tmp_path, monkeypatch
):
    """`pip install -e` leaves it where it is edited, whatever its version."""
    name = f"edited_in_{place.replace('-', '_')}"
    home = tmp_path / "else" / place
    info = f"{name}-1.0.dist-info"
    files = {f"{name}/__init__.py": "", f"{name}/inner/part.py": "A = 1\n"}
    files |= {f"{info}/METADATA": f"Name: {name}\nVersion: 1.0\n", f"{info}/top_level.txt": name}
    write(home, files)
    monkeypatch.syspath_prepend(home)
    monkeypatch.setattr(provenance, "_distributions", metadata.packages_distributions)
    write(tree, {"bench/ruler.py": f"import {name}\n"})
    before = digest(METHOD)
    assert libraries(METHOD)[name] == "1.0"
    write(home, {f"{name}/inner/part.py": "A = 2\n"})
    assert (digest(METHOD) != before) == (place == "src")


def test_a_module_that_is_imported_while_a_run_goes_on_is_refused(plugin, tmp_path):
    _, thing = plugin
    write(tmp_path / "site", {"imported_late.py": ""})
    loaded = set(sys.modules)
    importlib.import_module(f"{thing.__module__.partition('.')[0]}.helper")  # one of its files
    importlib.import_module("colorsys")  # of Python
    provenance._loaded.cache_clear()
    provenance.check_unchanged(loaded, thing)
    importlib.import_module("imported_late")
    with pytest.raises(SteerbenchError, match="imported_late was imported while the run went on"):
        provenance.check_unchanged(loaded, thing)
    assert "imported_late" not in sys.modules  # the next run imports it again, and is refused, too


def test_a_module_that_is_imported_by_a_made_name_is_refused(tree, tmp_path, monkeypatch):
    files = {"odd.py": "import importlib\nhelp = importlib.import_module('odd_' + 'help')\n"}
    write(tmp_path / "site", files | {"odd_help.py": "A = 1\n"})
    monkeypatch.syspath_prepend(tmp_path / "site")
    importlib.import_module("odd")
    with pytest.raises(SteerbenchError, match=r"odd_help was imported .* does not hold .*odd_help"):
        provenance.check_unchanged(set(sys.modules), defined_in("odd"))
    for name in ("odd", "odd_help"):
        del sys.modules[name]


@pytest.mark.parametrize("edit", ["A = 2222\n", "A = 2\n"])
def test_code_that_was_loaded_before_an_edit_is_refused_also_at_first(edit, tmp_path, monkeypatch):
    """As in a notebook; also of the same size and time, which Python itself takes for the same."""
    file = tmp_path / "loaded_early.py"
    file.write_text("A = 1\n")
    times = file.stat()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    importlib.import_module("loaded_early")
    thing = defined_in("loaded_early")
    digest(thing)
    file.write_text(f"# A comment.\n{edit}" if len(edit) > 6 else edit)
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    with pytest.raises(SteerbenchError, match=r"loaded_early.py was changed while this process"):
        digest(thing)
    del sys.modules["loaded_early"]
    assert digest(thing)


def test_a_method_that_a_notebook_replaced_is_refused(tmp_path, monkeypatch):
    (tmp_path / "patched.py").write_text("class Method:\n    def render(self): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    method = importlib.import_module("patched").Method
    loaded = set(sys.modules)
    provenance.check_unchanged(loaded, method)
    render = lambda self: 0  # noqa: E731
    render.__module__ = "__main__"
    method.render = render
    with pytest.raises(SteerbenchError, match=r"Method\.render was replaced"):
        provenance.check_unchanged(loaded, method)
    del sys.modules["patched"]


def test_files_behind_links_count_and_a_link_upwards_ends(tmp_path):
    write(tmp_path, {"here/a.py": "", "there/b.py": "", "here/.hidden/c.py": ""})
    (tmp_path / "here/linked").symlink_to(tmp_path / "there")
    (tmp_path / "there/up").symlink_to(tmp_path / "here")
    found = provenance.files_at(tmp_path / "here")
    assert sorted(str(path.relative_to(tmp_path)) for path in found) == [
        *("here/a.py", "here/linked/b.py")
    ]
    (tmp_path / "there/b.py").write_text("A = 1\n")
    before = provenance.sums_of([tmp_path / "here"], "reads")
    (tmp_path / "there/b.py").write_text("A = 2\n")
    assert provenance.sums_of([tmp_path / "here"], "reads") != before
    with pytest.raises(SteerbenchError, match=r"reads: expected files and folders, got .*nowhere"):
        provenance.sums_of([tmp_path / "nowhere"], "reads")


def test_docstrings_count_where_a_file_of_a_package_reads_them(tmp_path, monkeypatch):
    write(tmp_path, {"told/__init__.py": "", "told/base.py": "", "told/method.py": '"""One."""\n'})
    monkeypatch.syspath_prepend(tmp_path)
    thing = defined_in("told.method")
    digests = []
    for reads in ("", "def table(of):\n    return of.__doc__\n"):
        for text in ("One", "Two"):
            write(tmp_path, {"told/base.py": reads, "told/method.py": f'"""{text}."""\n'})
            digests.append(digest(thing))
    assert [len(set(digests[:2])), len(set(digests[2:]))] == [1, 2]


def test_what_was_installed_from_a_folder_counts_by_what_was_installed(tmp_path, monkeypatch):
    info = tmp_path / "own_library-0.1.dist-info"
    files = {"METADATA": "Name: own_library\nVersion: 0.1\n", "RECORD": "own.py,sha256=1,5\n"}
    write(info, files)
    monkeypatch.syspath_prepend(tmp_path)
    version = provenance._version.__wrapped__
    assert version("own_library") == "0.1"  # as from an index, where a version is final
    (info / "direct_url.json").write_text('{"url": "file:///own", "dir_info": {}}')
    before = version("own_library")
    (info / "RECORD").write_text("own.py,sha256=2,5\n")
    assert version("own_library") != before
    assert before.startswith("0.1+")


def test_what_may_have_changed_times_is_said(monkeypatch):
    then = provenance.machine()
    assert provenance.conditions_apart(then) == ""
    monkeypatch.setenv("OMP_PROC_BIND", "close")
    one_core = {**then, "affinity": 99}
    assert provenance.conditions_apart(then) == "OMP_PROC_BIND: None, now close"
    assert provenance.conditions_apart(one_core).startswith("cores: 99, now ")
    monkeypatch.setenv("TRITON_CACHE_DIR", "elsewhere")  # which changes nothing
    assert "TRITON" not in provenance.conditions_apart(then)


def test_a_single_file_counts_with_the_module_that_it_imports(tree, tmp_path, monkeypatch):
    write(tmp_path / "site", {"single_file.py": "import its_helper\n", "its_helper.py": "A = 1\n"})
    monkeypatch.syspath_prepend(tmp_path / "site")
    thing = defined_in("single_file")
    before = digest(thing)
    write(tmp_path / "site", {"its_helper.py": "A = 2\n"})
    assert digest(thing) != before


def test_libraries_are_those_that_the_sources_import_and_a_class_lists(tree):
    assert libraries(METHOD) == {"numpy": metadata.version("numpy")}
    assert libraries(defined_in("bench.unused")) == {}
    thing = defined_in("bench.unused", libraries=("scipy", "not-installed"))
    assert libraries(thing) == {"scipy": metadata.version("scipy")}


def test_a_library_that_was_half_removed_has_no_version_and_counts_as_absent(tree, monkeypatch):
    monkeypatch.setattr(provenance, "_version", lambda name: None)
    assert libraries(METHOD) == {}


@pytest.mark.parametrize(
    "change",
    [
        lambda patch: patch.setattr(provenance, "machine", lambda: {**MACHINE, "cpu": "another"}),
        lambda patch: patch.setattr(provenance, "machine", lambda: {**MACHINE, "threads": 99}),
        lambda patch: patch.setattr(provenance, "machine", lambda: {**MACHINE, "python": "4.0"}),
        lambda patch: patch.setattr(provenance, "libraries", lambda *_: {"torch": "99"}),
        lambda patch: patch.setenv("NUMBA_NUM_THREADS", "99"),
        lambda patch: patch.setenv("ATEN_CPU_CAPABILITY", "default"),
        lambda patch: patch.setenv("ONEDNN_MAX_CPU_ISA", "SSE41"),
    ],
)
def test_what_else_decides_a_result_is_part_of_its_key(change, monkeypatch):
    monkeypatch.setattr(provenance, "machine", lambda: MACHINE)
    before = computed_by(measure)
    assert computed_by(measure) == before
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")  # a key has the names of GPUs
    assert computed_by(measure) == before
    change(monkeypatch)
    assert computed_by(measure) != before


def test_a_real_training_stands_on_its_backends_and_not_on_how_results_are_shown():
    assert {"torch", "numba"} <= libraries(train_field).keys()
    assert {"torch", "scipy", "torchvision", "scikit-image", "lpips"} <= libraries(measure).keys()
    names = provenance.sources(train_field)
    assert "methods/instant_ngp/training.py" in names
    assert not [name for name in names if name.startswith(("bench/results", "bench/console"))]
    assert "pandas" not in libraries(train_field)
