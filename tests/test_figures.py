"""The documents show what the commands of docs/figures.toml wrote, all from one commit."""

import csv
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from docs import figures
from tests.common import ROOT

DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
END = "<!-- end of figures -->"

PROGRAM = f"""#!{sys.executable}
import sys
from pathlib import Path

command, *words = sys.argv[1:]
for word in words:
    if word.startswith("report="):
        folder = Path(word.removeprefix("report="))
        (folder / "grey-12.png").write_bytes(Path("grey-12.png").read_bytes())
        (folder / "report.md").write_text(Path("page.md").read_text())
if command == "results":
    print("## Results\\n\\n| run | level |\\n|---|---:|\\n| grey | 0.5 |")
sys.exit("fail" in words)
"""
"""Stands for steerbench: it has a page to write and a table to print."""

PAGE = """# Grey

| run | PSNR, dB ↑ |
|---|---:|
| grey | 6.02 |

What follows.

## Pictures

![a grey](grey-12.png)
"""


def region(name: str, heading: str, what: str, content: str = "old") -> str:
    return f"<!-- figures {name} | {heading} | {what} -->\n{content}\n{END}"


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder with a list of figures, code, and a document outside and one inside of docs/."""
    monkeypatch.chdir(tmp_path)
    for folder in ("docs", "bench"):
        (tmp_path / folder).mkdir()
    program = tmp_path / "program"
    program.write_text(PROGRAM)
    program.chmod(0o755)
    monkeypatch.setattr(figures, "STEERBENCH", program)
    (tmp_path / "page.md").write_text(PAGE)
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(tmp_path / "grey-12.png")
    (tmp_path / "bench/code.py").write_text("one = 1\n")
    listed = {
        "run": "run report={folder}", "list": "results", "real": "run scene.path={data}/mic"
    }  # fmt: skip
    lines = (f"[{name}]\ncommand = '{command}'\n" for name, command in listed.items())
    (tmp_path / figures.LIST).write_text("\n".join(lines))
    text = f"before\n\n{region('run', '', 'table')}\n\n{region('run', 'Pictures', 'picture')}\n"
    (tmp_path / "README.md").write_text(f"{text}\nafter\n")
    more = [region("run", "Pictures", "picture"), region("list", "", "table")]
    (tmp_path / "docs/more.md").write_text("\n".join(more))
    who = ["-c", "user.name=x", "-c", "user.email=x@x"]
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-qm", "all"]):
        subprocess.run(["git", *words], check=True)
    return tmp_path


def test_documents_get_tables_pictures_and_where_they_are_from(checkout, capsys):
    assert figures.main([]) == 0
    assert "real: left out, it needs --data DIR" in capsys.readouterr().err
    readme, more = (checkout / "README.md").read_text(), (checkout / "docs/more.md").read_text()
    assert readme.startswith("before\n\n")
    assert readme.endswith("\n\nafter\n")
    assert re.search(r"`steerbench run`, at [0-9a-f]{12}, on \d+ threads of ", readme)
    assert "|run|PSNR, dB ↑|" in readme
    (shown,) = re.findall(r"\((docs/results/run-grey\.png)\)", readme)
    assert f"({shown.removeprefix('docs/')})" in more
    with Image.open(checkout / shown) as picture:
        assert picture.mode == "P"
    assert "|grey|0.5|" in more  # a table that a command without a page printed


def test_what_is_of_the_same_code_is_used_again_and_named_otherwise(checkout, capsys):
    def said(*words):
        figures.main(["--only", "run", *words])
        return capsys.readouterr().err

    assert "run: missing" in said("--check")
    assert "run: steerbench run" in said()
    first = (checkout / "README.md").read_text()
    assert said().startswith("run: made at")
    assert (checkout / "README.md").read_text() == first
    (checkout / "bench/code.py").write_text("one = 2\n")
    assert "of other code" in said("--check")
    assert figures.main(["--only", "run", "--check"]) == 1


def test_what_a_failing_command_left_is_not_shown_and_the_others_are_measured(checkout):
    text = (checkout / figures.LIST).read_text()
    wrong = "[wrong]\ncommand = 'run fail report={folder}'\n"
    (checkout / figures.LIST).write_text(f"{wrong}{text}")
    (checkout / "docs/wrong.md").write_text(region("wrong", "", "all"))
    assert figures.main([]) == 1
    assert (checkout / "docs/wrong.md").read_text() == region("wrong", "", "all")
    assert "|run|PSNR, dB ↑|" in (checkout / "README.md").read_text()


def test_the_folder_of_data_may_have_a_space(checkout, capsys):
    figures.main(["--only", "real", "--data", "/my data"])
    assert "real: steerbench run 'scene.path=/my data/mic'" in capsys.readouterr().err


def test_tables_of_a_page_stand_apart_in_its_csv_file():
    page = "# One\n\n| a |\n|---|\n| 1 |\n\n| b |\n|---|\n| 2 |\n"
    assert [*figures._rows(page)] == [[], ["One"], ["a"], ["1"], [], ["b"], ["2"]]


@pytest.mark.parametrize(
    ("wanted", "error"),
    [
        (("Nothing", "all"), "expected a heading that begins 'Nothing', got 'Grey', 'Pictures'"),
        (("Grey", "picture"), "README.md: figures run | Grey: it has no picture"),
        (("", "table of PSRN"), "expected one of the columns run, PSNR, got PSRN"),
    ],
)
def test_a_region_that_cannot_be_filled_is_named(checkout, wanted, error):
    (checkout / "README.md").write_text(region("run", *wanted))
    with pytest.raises(SystemExit) as ended:
        figures.main(["--only", "run"])
    assert error in str(ended.value)


@pytest.mark.parametrize("what", ["table 0", "bold"])
def test_a_document_shows_few_lines_of_a_long_table(checkout, what):
    """All are in the CSV file, which stays while a document names it."""
    (checkout / "README.md").write_text(region("run", "", what))
    figures.main([])
    readme = (checkout / "README.md").read_text()
    assert "0 of 1 lines; all: [run.csv](docs/results/run.csv)" in readme
    (file,) = (checkout / "docs/results").glob("*.csv")
    rows = [*csv.reader(file.read_text().splitlines())]
    assert next(row for row in rows if row[:1] == ["run"])[1] == "PSNR, dB ↑"


def test_a_document_shows_some_columns_of_a_table(checkout):
    (checkout / "README.md").write_text(region("run", "", "table of PSNR, run"))
    assert figures.main(["--only", "run"]) == 0
    shown = (checkout / "README.md").read_text()
    table = [x for x in shown.splitlines() if x.startswith("|")]
    assert table == ["|PSNR, dB ↑|run|", "|---:|---|", "|6.02|grey|"]
    assert "All columns: [run.csv](docs/results/run.csv)." in shown
    assert shown.startswith("<!-- figures run |  | table of PSNR, run | ")


def test_what_follows_a_table_is_not_a_line_of_it(checkout):
    (checkout / "README.md").write_text(region("run", "", "all"))
    assert figures.main(["--only", "run"]) == 0
    assert "|grey|6.02|\n\nWhat follows." in (checkout / "README.md").read_text()


# The documents of this checkout


def regions() -> list[tuple[Path, re.Match[str]]]:
    return [(path, x) for path in DOCUMENTS for x in figures.REGION.finditer(path.read_text())]


def test_all_figures_of_the_documents_are_of_one_commit():
    commits = {re.search(r"\| ([0-9a-f]{12}) -->", found[0])[1] for _, found in regions()}
    assert len(commits) == 1


def test_every_region_is_of_a_listed_command():
    listed = tomllib.loads((ROOT / figures.LIST).read_text())
    assert {found["name"] for _, found in regions()} <= set(listed)
