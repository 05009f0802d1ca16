"""The page for a browser: what Markdown has, in one file that loads nothing, and what clicks do."""

import base64
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from markdown_it import MarkdownIt
from PIL import Image

from reports import publish
from reports.images import ComparedFrame, RunView
from reports.page import write_page
from reports.tables import Table
from tests.reports.conftest import rename, rewrite

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
FIRST = re.compile(r"first: tiny, .*, frame 1 of 6")


class Parsed(HTMLParser):
    """The elements of a page, each with its attributes."""

    def __init__(self, text):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.feed(text)

    def of(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    def values(self, attribute):
        return [found[attribute] for _, found in self.elements if attribute in found]

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, {name: value or "" for name, value in attrs}))


def cells(page: str) -> list[str]:
    """The cells of all tables, without the links in them."""
    return re.findall(r"<t[hd](?: [^>]*)?>(.*?)</t[hd]>", re.sub(r"</?a[^>]*>", "", page))


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> Path:
    """Where the page of each device is kept: no test changes one."""
    return tmp_path_factory.mktemp("pages")


@pytest.fixture
def page(several, pages, device) -> Path:
    """The folder of the page of six runs, and of one that failed."""
    if not (pages / device).exists():
        write_page(*several, pages / device, {"gone | lost": "no memory"})
    return pages / device


@pytest.fixture
def parsed(page) -> Parsed:
    return Parsed((page / "report.html").read_text())


def test_every_table_of_the_markdown_page_is_there_with_its_figures_and_marks(page):
    markdown = MarkdownIt("commonmark").enable("table").render((page / "report.md").read_text())
    assert any(cell.startswith("<strong>") for cell in cells(markdown))
    assert cells((page / "report.html").read_text()) == cells(markdown)


def test_columns_of_figures_are_aligned_right():
    page = publish.html_page(["# T", Table("t", ("name", "ms"), (("a", "1.5"),))], [])
    assert re.findall(r"<t[hd]( [^>]*)?>", page) == 2 * ["", ' style="text-align:right"']


def test_nothing_is_loaded_from_elsewhere(page, parsed):
    links = [*parsed.values("src"), *parsed.values("href"), *parsed.values("xlink:href")]
    assert all(link.startswith(("data:", "#")) for link in links)
    assert {tag for tag, _ in parsed.elements} & {"link", "iframe", "object", "embed"} == set()
    assert re.findall(r"url\((?!#)|@import|fetch\(", (page / "report.html").read_text()) == []


def test_every_picture_says_what_it_shows(parsed):
    assert len(parsed.of("img")) == 3 * (1 + 6 * 2)  # three frames: the truth, six runs with errors
    assert all(image["alt"] for image in parsed.of("img"))
    assert len({image["alt"] for image in parsed.of("img")}) == len(parsed.of("img"))
    assert all(drawn["aria-label"] for drawn in parsed.of("svg"))


def test_pictures_lose_nothing(several, stored_run, parsed):
    (shown,) = (image for image in parsed.of("img") if FIRST.fullmatch(image["alt"]))
    stored = several[0].folder / stored_run / "pictures/0000-rendered.png"
    content = base64.b64decode(shown["src"].partition(",")[2])
    with Image.open(io.BytesIO(content)) as picture, Image.open(stored) as rendered:
        assert np.array_equal(picture.convert("RGB"), rendered.convert("RGB"))


def test_a_page_with_large_pictures_says_that_they_are_compressed(monkeypatch):
    grey = np.full((8, 8, 3), 99, np.uint8)
    views = [RunView(("a", "b"), grey, grey)]
    frame = ComparedFrame(
        "ball, 0", "frame", grey, views, (0, 0, 2, 2), "nothing differs", "no error"
    )
    assert "compressed" not in publish.html_page(["# Title", frame], [])
    monkeypatch.setattr(publish, "LOSSLESS_PIXELS", 63)
    assert "compressed for this page: WebP, quality 90" in publish.html_page(["# Title", frame], [])


def test_every_line_and_mark_leads_to_its_run_and_every_link_somewhere(several, parsed):
    keys = set(several[1])
    assert {f"run-{key}" for key in keys} <= set(parsed.values("id"))
    named = [line["data-runs"] for line in parsed.of("tr") if "data-runs" in line]
    marked = [mark["data-runs"] for mark in parsed.of("g") if "data-runs" in mark]
    assert set(named) == keys
    assert marked == list(several[1]) * 2  # quality against time, quality against memory
    assert {link["href"] for link in parsed.of("a") if link.get("class") == "origin"} == {
        f"#run-{key}" for key in keys
    }
    assert all("steerbench run seed=5" in line["title"] for line in parsed.of("tr") if line)
    ids = parsed.values("id")
    assert len(ids) == len(set(ids))
    assert {link["href"][1:] for link in parsed.of("a")} <= set(ids)


HOSTILE = "<script>x</script>![](http://a/b.png)"


def test_names_are_text_and_nothing_else(store, stored_run, tmp_path):
    rows = store.folder / stored_run / "rows.csv"
    rows.write_text(rows.read_text().replace(",tiny,", f",{HOSTILE},"))
    rewrite(store, stored_run, command=HOSTILE, error_map=HOSTILE)
    rename(store, stored_run, HOSTILE)
    write_page(store, [stored_run], tmp_path / "page", {HOSTILE: HOSTILE})
    text = (tmp_path / "page/report.html").read_text()
    assert "<script>x" not in text
    assert text.count("&lt;script&gt;x") > 10
    assert len(Parsed(text).of("script")) == 1
    assert all(image["src"].startswith("data:") for image in Parsed(text).of("img"))


# In a browser


def in_browser(page: str, clicks: str, folder: Path) -> dict[str, object]:
    """What `clicks`, the body of a function, returns after `page` has loaded; fails on errors."""
    watch = "const seen = []; addEventListener('error', (event) => seen.push(event.message));"
    act = (
        f"const found = (() => {{ {clicks} }})();"
        "document.title = JSON.stringify({ ...found, errors: seen });"
    )
    page = page.replace("<style>", f"<script>{watch}</script><style>", 1)
    page = page.replace("</body>", f"<script>{act}</script></body>")
    (folder / "clicked.html").write_text(page)
    flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    command = [str(CHROMIUM), *flags, "--dump-dom", (folder / "clicked.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    (title,) = re.findall(r"<title>(\{.*?\})</title>", done.stdout)
    found = json.loads(title.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))
    assert found.pop("errors") == []
    return found


needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")

SORT = """
const heads = [...document.querySelectorAll("th")];
const press = (column) => {
  heads[column].querySelector("button").click();
  const order = [...document.querySelectorAll("td:first-child")].map((cell) => cell.textContent);
  return [heads[column].getAttribute("aria-sort"), order.join("")];
};
const sorted = [press(1), press(1), press(1), press(2), press(0)];
const box = document.querySelector("input[type=search]");
box.value = "c 1,00";
box.dispatchEvent(new Event("input"));
const left = [...document.querySelectorAll("tbody tr:not([hidden])")].map((row) => row.innerText);
return { sorted, left };
"""


@needs_browser
def test_a_click_on_a_head_sorts_numbers_as_numbers_the_best_above_and_the_missing_below(tmp_path):
    lines = (
        ("a", "×9.50 (×1.00)", "1,000.0"),
        ("b", "– (-1.78)", "n/a"),
        ("c", "10.25 ± 0.10 (+1.00)", "1,001.0"),
        ("d", "-3.00", "2e-3"),
        ("e", "**9.60**", "900.0"),
    )
    table = Table("t", ("name", "PSNR, dB ↑", "ms ↓"), lines)
    found = in_browser(publish.html_page(["# Title", table], []), SORT, tmp_path)
    assert found["sorted"] == [
        ["descending", "ceadb"],
        ["ascending", "daecb"],
        [None, "abcde"],
        ["ascending", "deacb"],
        ["ascending", "abcde"],
    ]
    (left,) = found["left"]
    assert left.startswith("c\t")


LOOK = """
const one = (name) => document.querySelector(name);
const frame = one(".frame");
const [left, right] = frame.querySelectorAll("select");
const [enlarge, errors] = frame.querySelectorAll("button");
const alts = () => [one(".left img").alt, one(".layer:not(.left) img").alt];
const begun = alts();
right.selectedIndex = 0;
right.dispatchEvent(new Event("change"));
const changed = alts();
errors.click();
const maps = alts();
enlarge.click();
const zoomed = one(".stage").className;
const slider = frame.querySelector("input");
slider.value = 25;
slider.dispatchEvent(new Event("input"));
const split = one(".stage").style.getPropertyValue("--split");
const panel = one("#origin");
const hidden = panel.hidden;
one(".mark").dispatchEvent(new Event("focus"));
const mark = panel.innerText;
panel.querySelector("button").click();
one("tr[data-runs] td:last-child").click();
return { begun, changed, maps, zoomed, split, hidden, mark, row: panel.innerText };
"""


@needs_browser
def test_pictures_lie_under_a_divider_and_marks_and_rows_show_their_run(page, stored_run, tmp_path):
    found = in_browser((page / "report.html").read_text(), LOOK, tmp_path)
    (where,) = {alt.partition(": ")[2] for alt in found["begun"]}
    assert found["begun"] == [f"first: {where}", f"copy 0: {where}"]
    assert found["changed"] == [f"first: {where}", f"ground truth: {where}"]
    assert found["maps"][0].startswith("first: absolute error")
    assert found["maps"][1] == f"ground truth: {where}"
    assert found["zoomed"] == "stage zoomed"
    assert found["split"] == "25%"
    assert found["hidden"]
    for shown in (found["mark"], found["row"]):
        assert stored_run in shown
        assert "steerbench run seed=5" in shown
    assert re.search(r"first: PSNR [\d.]+ dB, [\d.]+ ms a frame", found["mark"])
    assert found["row"].splitlines()[1].startswith("first: PSNR, dB ")
