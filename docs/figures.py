"""Measures what the documents show, and puts it into them: `make figures`.

docs/figures.toml names the commands. A document shows a part of what one of them wrote between two
comments, `<!-- figures NAME | HEADING | WHAT -->` and `<!-- end of figures -->`: of the section of
its page whose heading begins so (none: the first), the first `table`, the `bold` lines of it, the
first `picture`, or `all`. `table 8` has its first lines, `table of case, ms` those columns whose
heading is so up to its unit. What is between the comments is replaced. The page of a command is
what it writes into {folder}, or else what it prints.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from PIL import Image

from bench import provenance

LIST = Path("docs/figures.toml")
RESULTS = Path("docs/results")
CODE = ("bench", "methods", "sweeps")  # what figures depend on
FOLDER = Path("outputs/figures")
PAGE = "report.md"
MADE = "made.json"  # beside a page: what made it
STEERBENCH = Path(sys.executable).with_name("steerbench")

REGION = re.compile(
    r"<!-- figures (?P<name>[\w-]+) \| (?P<heading>[^|\n]*?) \| "
    r"(?P<what>(?P<part>all|table|bold|picture)(?: (?P<most>\d+))?(?: of (?P<columns>[^|\n]+?))?)"
    r"(?: \|[^\n]*)? -->\n.*?<!-- end of figures -->",
    re.DOTALL,
)
HEADING = re.compile(r"^#{1,2} (.*)$", re.MULTILINE)
PICTURE = re.compile(r"^!\[(.*)\]\((.+)\)$", re.MULTILINE)
CELL = re.compile(r"(?<!\\)\|")  # what is between two cells of a table
UNIT = re.compile(r",| [↑↓]")  # begins what a heading says after its name
TABLE = re.compile(r"^\|.*\|$(?:\n\|.*\|$)*", re.MULTILINE)

COLOURS_OF_A_PLOT = 2**14  # at most; a picture with more shows renderings
QUALITY = 90  # of WebP


@dataclass(frozen=True)
class Made:
    """What made a page: the `command`, at which commit, from which `code`, on which machine."""

    command: str
    commit: str
    code: str  # digest of all that computes figures
    machine: str

    @property
    def told(self) -> str:
        """As a line above the figures; DIR is what --data names."""
        command = re.sub(r" (--)?report[ =]\{folder\}", "", self.command).format(data="DIR")
        return f"`{command}`, at {self.commit}, on {self.machine}:"


def main(argv: Sequence[str]) -> int:
    """Measure what is missing or of other code, fill the documents; return 1 if anything failed."""
    parser = argparse.ArgumentParser(description="Measure all that the documents show.")
    parser.add_argument("--only", help="only what has this name in the list", action="append")
    parser.add_argument("--data", help="the folder of NeRF-Synthetic; what needs it is left out")
    parser.add_argument(
        "--check",
        help="measure nothing; name what is missing or of other code",
        action="store_true",
    )
    options = parser.parse_args(argv)
    wanted = tomllib.loads(LIST.read_text(encoding="utf-8"))
    code, failed = _code(), 0
    for name in options.only or wanted:
        command, folder = f"steerbench {wanted[name]['command']}", FOLDER / name
        before = _read(folder)
        if before and (before.command, before.code) == (command, code):
            _say(f"{name}: made at {before.commit}")
        elif options.check:
            _say(f"{name}: {f'made at {before.commit}, of other code' if before else 'missing'}")
            failed += 1
        elif "{data}" in command and options.data is None:
            _say(f"{name}: left out, it needs --data DIR")
        else:
            _, *words = (x.format(folder=folder, data=options.data) for x in shlex.split(command))
            _say(f"{name}: steerbench {shlex.join(words)}")
            failed += not _measure(words, folder, Made(command, _commit(), code, _machine()))
    if not options.check:
        _fill({name: FOLDER / name for name in wanted if _read(FOLDER / name)})
    return int(failed > 0)


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _measure(words: Sequence[str], folder: Path, made: Made) -> bool:
    """Run a command and keep its page in `folder`; whether it succeeded."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MADE).unlink(missing_ok=True)  # a command that fails may have written its page
    ended = subprocess.run([STEERBENCH, *words], stdout=subprocess.PIPE, text=True, check=False)
    if ended.returncode:
        return False
    if "{folder}" not in made.command:
        (folder / PAGE).write_text(ended.stdout, encoding="utf-8")
    (folder / MADE).write_text(json.dumps(asdict(made), indent=1) + "\n", encoding="utf-8")
    return True


def _read(folder: Path) -> Made | None:
    file = folder / MADE
    return Made(**json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else None


def _code() -> str:
    digest = hashlib.sha256()
    for path in sorted(path for top in CODE for path in Path(top).rglob("*") if path.is_file()):
        if "__pycache__" not in path.parts:
            digest.update(f"{path}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _commit() -> str:
    """The commit that last changed the code, marked if it was changed since."""
    commit = _git("log", "-1", "--format=%h", "--abbrev=12")
    return f"{commit}-dirty" if _git("status", "--porcelain") else commit


def _git(*words: str) -> str:
    command = ["git", *words, "--", *CODE]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _machine() -> str:
    machine = provenance.machine()
    return f"{machine['threads']} threads of {machine['cpu']}"


# Documents


def _fill(pages: Mapping[str, Path]) -> None:
    """Put what `pages` show into the regions of all documents, and their tables into CSV files."""
    RESULTS.mkdir(exist_ok=True)
    for name, folder in pages.items():
        text = (folder / PAGE).read_text(encoding="utf-8")
        with (RESULTS / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(_rows(text))
    documents = sorted([*Path().glob("*.md"), *Path("docs").glob("*.md")])
    texts = {}
    for document in documents:
        before = document.read_text(encoding="utf-8")
        told: set[str] = set()
        region = partial(_region, document=document, pages=pages, told=told)
        texts[document] = REGION.sub(region, before)
        if texts[document] != before:
            document.write_text(texts[document], encoding="utf-8")
    for shown in RESULTS.iterdir():
        if not any(f"/{shown.name})" in text for text in texts.values()):
            shown.unlink()


def _region(
    region: re.Match[str], document: Path, pages: Mapping[str, Path], told: set[str]
) -> str:
    """A region of `document` with the present figures of its page; as it was without the page.

    The first one of a page tells what made it; `told` are the names of pages that have.
    """
    name, heading, part = region["name"], region["heading"], region["part"]
    most = int(region["most"]) if region["most"] else None
    columns = region["columns"].split(", ") if region["columns"] else ()
    if name not in pages:
        return region[0]
    folder, made = pages[name], _read(pages[name])
    assert made is not None
    text = _section((folder / PAGE).read_text(encoding="utf-8"), heading, name)
    if part != "all":
        found = (PICTURE if part == "picture" else TABLE).search(text)
        if not found:
            raise SystemExit(f"{document}: figures {name} | {heading}: it has no {part}")
        text = found[0]
    to_results = RESULTS if document.parent == Path() else RESULTS.relative_to(document.parent)

    def shorter(table: re.Match[str]) -> str:
        head, rule, *lines = table[0].splitlines()
        kept = [x for x in lines if part != "bold" or x.startswith("| **")][:most]
        if part == "bold":  # where all lines are, none stands out
            kept = [re.sub(r"\*\*(.*?)\*\*", r"\1", x, count=1) for x in kept]
        rows = _of_columns([head, rule, *kept], columns)
        if rows == _of_columns([head, rule, *lines], ()):
            return "\n".join(rows)
        few = f"{len(kept)} of {len(lines)} lines; all" if len(kept) < len(lines) else "All columns"
        return "\n".join([*rows, "", f"{few}: [{name}.csv]({to_results / name}.csv)."])

    def copied(picture: re.Match[str]) -> str:
        return f"![{picture[1]}]({to_results / _copy(folder / picture[2], name)})"

    text = PICTURE.sub(copied, TABLE.sub(shorter, text))
    first = name not in told
    told.add(name)
    start = f"<!-- figures {name} | {heading} | {region['what']} | {made.commit} -->"
    made_by = f"{made.told}\n\n" if first else ""
    return f"{start}\n{made_by}{text}\n<!-- end of figures -->"


def _of_columns(rows: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """The `rows` of a table with the `wanted` columns alone, none: all; no space beside bars."""
    cells = [[cell.strip() for cell in CELL.split(row)[1:-1]] for row in rows]
    names = [UNIT.split(cell)[0] for cell in cells[0]]
    for name in wanted:
        if name not in names:
            raise SystemExit(f"expected one of the columns {', '.join(names)}, got {name}")
    chosen = [names.index(name) for name in wanted] or range(len(names))
    return [f"|{'|'.join(row[column] for column in chosen)}|" for row in cells]


def _section(text: str, heading: str, name: str) -> str:
    """The section of a page, without its heading, that begins with `heading`."""
    found = [*HEADING.finditer(text)]
    ends = [*(each.start() for each in found[1:]), len(text)]
    sections = {
        each[1]: text[each.end() : end].strip() for each, end in zip(found, ends, strict=True)
    }
    for title in (heading, *(x for x in sections if x.startswith(heading))):
        if title in sections:
            return sections[title]
    there = ", ".join(repr(each[1]) for each in found)
    raise SystemExit(f"figures {name}: expected a heading that begins {heading!r}, got {there}")


def _copy(picture: Path, name: str) -> str:
    """Copy a picture into the results, with few colours or, of a rendering, with little loss; the
    name that it has there."""
    stem = picture.stem.rpartition("-")[0]  # without the digest
    with Image.open(picture) as image:
        pixels = image.convert("RGB")
    if pixels.getcolors(COLOURS_OF_A_PLOT):
        few = pixels.quantize(dither=Image.Dither.NONE)
        few.save(RESULTS / f"{name}-{stem}.png", optimize=True)
        return f"{name}-{stem}.png"
    pixels.save(RESULTS / f"{name}-{stem}.webp", quality=QUALITY, method=6)
    return f"{name}-{stem}.webp"


def _rows(text: str) -> Iterator[list[str]]:
    """The cells of all tables of a page, below the heading of each, an empty line between them."""
    heading, inside = "", False
    for line in text.splitlines():
        if line.startswith("#"):
            heading = line.lstrip("# ")
        elif line.startswith("| "):
            if not inside:
                yield from ([], [heading]) if heading else ([],)
                heading = ""
            cells = [cell.strip() for cell in CELL.split(line)[1:-1]]
            yield [cell.replace("\\|", "|").strip("*") for cell in cells]
        inside = line.startswith("|")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
