"""The documents show what the commands of docs/figures.toml wrote, all from one commit."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import tomllib
from argparse import Namespace
from pathlib import Path
from unittest.mock import Mock

import pytest
from PIL import Image

from sweeps.commands import figures
from tests.sweeps.conftest import CONFIGS, QUICK

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
RUN = f"run {CONFIGS} {' '.join(QUICK)} report={{folder}}"
END = "<!-- end of figures -->"


def region(name: str, heading: str, what: str, content: str = "old") -> str:
    return f"<!-- figures {name} | {heading} | {what} -->\n{content}\n{END}"


@pytest.fixture
def checkout(elsewhere, tmp_path):
    """A folder with a list of figures, code, and a document outside and one inside of docs/."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "code.py").write_text("one = 1\n")
    listed = {"run": RUN, "list": "results", "real": "run scene.path={data}/mic"}
    lines = (f"[{name}]\ncommand = {json.dumps(command)}\n" for name, command in listed.items())
    (tmp_path / figures.LIST).write_text("\n".join(lines))
    text = f"before\n\n{region('run', '', 'table')}\n\n{region('run', 'Pictures', 'picture')}\n"
    (tmp_path / "README.md").write_text(f"{text}\nafter\n")
    more = [region("run", "Pictures", "picture"), region("list", "", "table")]
    (tmp_path / "docs" / "more.md").write_text("\n".join(more))
    who = ["-c", "user.name=x", "-c", "user.email=x@x"]
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-qm", "all"]):
        subprocess.run(["git", *words], check=True)
    return tmp_path


def test_documents_get_tables_pictures_and_where_they_are_from(steerbench, checkout):
    outcome = steerbench("figures").ok()
    assert "real: left out, it needs --data DIR" in outcome.err
    readme, more = (checkout / "README.md").read_text(), (checkout / "docs/more.md").read_text()
    assert readme.startswith("before\n\n")
    assert readme.endswith("\n\nafter\n")
    assert re.search(
        rf"`steerbench {re.escape(RUN.partition(' report')[0])}`, at [0-9a-f]{{12}}, on ", readme
    )
    assert "|run|PSNR, dB ↑|" in readme
    (shown,) = re.findall(r"\((docs/results/run-\S+\.png)\)", readme)
    assert f"({shown.removeprefix('docs/')})" in more
    assert "|grey|" in more  # a table that a command without a page printed
    with Image.open(checkout / shown) as picture:
        assert picture.mode == "P"


def test_what_is_of_the_same_code_is_used_again_and_named_otherwise(steerbench, checkout):
    assert "run: missing" in steerbench("figures", "--only", "run", "--check").err
    assert "run: steerbench run" in steerbench("figures", "--only", "run").err
    first = (checkout / "README.md").read_text()
    again = steerbench("figures", "--only", "run")
    assert "run: made at" in again.err
    assert "run: steerbench run" not in again.err
    assert (checkout / "README.md").read_text() == first
    (checkout / "bench" / "code.py").write_text("one = 2\n")
    later = steerbench("figures", "--only", "run", "--check")
    assert later.status == 1
    assert "of other code" in later.err


def test_a_command_that_fails_leaves_its_region_and_the_others_are_measured(steerbench, checkout):
    text = (checkout / figures.LIST).read_text()
    (checkout / figures.LIST).write_text(f'[wrong]\ncommand = "run scene=nowhere"\n{text}')
    (checkout / "docs" / "wrong.md").write_text(region("wrong", "", "all"))
    outcome = steerbench("figures")
    assert outcome.status == 1
    assert "nowhere" in outcome.err
    assert (checkout / "docs" / "wrong.md").read_text() == region("wrong", "", "all")
    assert "|run|PSNR, dB ↑|" in (checkout / "README.md").read_text()


def test_a_page_that_a_failing_command_wrote_is_not_shown_as_an_earlier_one(
    steerbench, checkout, monkeypatch
):
    assert steerbench("figures", "--only", "run").status == 0
    (checkout / "bench" / "code.py").write_text("one = 2\n")
    before = (checkout / "README.md").read_text()

    def failing(argv):
        (checkout / "outputs/figures/run/report.md").write_text("# New\n\n| a |\n|---|\n| 1 |\n")
        return 1

    monkeypatch.setattr(figures.cli, "dispatch", failing)
    assert figures.main(Namespace(only=["run"], check=False, data=None)) == 1
    assert (checkout / "README.md").read_text() == before


def test_the_folder_of_data_may_have_a_space(checkout, monkeypatch):
    monkeypatch.setattr(figures.cli, "dispatch", called := Mock(return_value=1))
    figures.main(Namespace(only=["real"], check=False, data=Path("/my data")))
    called.assert_called_once_with(["run", "scene.path=/my data/mic"])


def test_an_interruption_ends_all_commands(checkout, monkeypatch):
    monkeypatch.setattr(figures.cli, "dispatch", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        figures.main(Namespace(only=["list"], check=False, data=None))


def test_tables_of_a_page_stand_apart_in_its_csv_file():
    page = "# One\n\n| a |\n|---|\n| 1 |\n\n| b |\n|---|\n| 2 |\n"
    assert [*figures._rows(page)] == [[], ["One"], ["a"], ["1"], [], ["b"], ["2"]]


@pytest.mark.parametrize(
    ("wanted", "error"),
    [
        (("Nothing", "all"), "expected a heading that begins 'Nothing', got 'grey on white'"),
        (("Provenance", "picture"), "README.md: figures run | Provenance: it has no picture"),
        (("", "table of PSRN"), "unknown column 'PSRN'. Did you mean PSNR?"),
    ],
)
def test_a_region_that_cannot_be_filled_is_named(steerbench, checkout, wanted, error):
    (checkout / "README.md").write_text(region("run", *wanted))
    assert error in steerbench("figures", "--only", "run").refused()


@pytest.mark.parametrize("what", ["table 0", "bold"])
def test_a_document_shows_few_lines_of_a_long_table(steerbench, checkout, what):
    """All are in the CSV file, which stays while a document names it."""
    (checkout / "README.md").write_text(region("run", "", what))
    steerbench("figures")
    readme = (checkout / "README.md").read_text()
    assert "0 of 1 lines; all: [run.csv](docs/results/run.csv)" in readme
    (file,) = (checkout / "docs/results").glob("*.csv")
    rows = [*csv.reader(file.read_text().splitlines())]
    assert next(row for row in rows if row[:1] == ["run"])[1] == "PSNR, dB ↑"


def test_a_document_shows_some_columns_of_a_table(steerbench, checkout):
    (checkout / "README.md").write_text(region("run", "", "table of PSNR, run"))
    assert steerbench("figures", "--only", "run").status == 0
    shown = (checkout / "README.md").read_text()
    head, rule, line = (x for x in shown.splitlines() if x.startswith("|"))
    assert (head, rule) == ("|PSNR, dB ↑|run|", "|---:|---|")
    assert re.fullmatch(r"\|[\d.]+\|\w+\|", line)
    assert "All columns: [run.csv](docs/results/run.csv)." in shown
    assert shown.startswith("<!-- figures run |  | table of PSNR, run | ")


def test_what_follows_a_table_is_not_a_line_of_it(steerbench, checkout):
    (checkout / "README.md").write_text(region("run", "", "all"))
    assert steerbench("figures", "--only", "run").status == 0
    shown = (checkout / "README.md").read_text()
    table = [place for place, x in enumerate(shown.splitlines()) if x.startswith("|")]
    assert shown.splitlines()[table[-1] + 1] == ""


# The documents of this checkout


def regions() -> list[tuple[Path, re.Match[str]]]:
    return [(path, x) for path in DOCUMENTS for x in figures.REGION.finditer(path.read_text())]


def test_all_figures_of_the_documents_are_of_one_commit():
    commits = {re.search(r"\| ([0-9a-f]{12}) -->", found[0])[1] for _, found in regions()}
    assert len(commits) == 1


def test_every_region_is_of_a_listed_command():
    listed = tomllib.loads((ROOT / figures.LIST).read_text())
    assert {found["name"] for _, found in regions()} <= set(listed)
