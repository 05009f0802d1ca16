"""What experiments declare as tables, and what is refused in a declaration."""

from pathlib import Path

import pytest

from bench.errors import SteerbenchError
from sweeps.data_sets import DATA_SETS, FIRST
from sweeps.experiments import experiment, grid
from sweeps.tables import chosen
from tests.common import refusal

_, SECOND = DATA_SETS
TABLES = {table.name: table for table in chosen()}
BOTH = {table.name: table for table in chosen(data_sets=[FIRST, SECOND])}


def test_the_experiments_declare_the_six_tables_of_the_paper():
    assert list(TABLES) == [f"table{number}" for number in range(1, 7)]
    for table in TABLES.values():
        assert len({line.label for line in table.lines.values()}) == len(table.lines)
        for line in table.lines.values():
            for figures in line.published.values():
                assert set(figures) <= {*table.metrics, "frame_ms"}, line.label


@pytest.mark.parametrize("name", TABLES)
def test_a_second_data_set_has_its_figures_in_a_block_if_the_paper_has_any(name):
    both, has = BOTH[name], name in ("table1", "table2")
    assert both.data_sets == [FIRST, SECOND][: 1 + has]
    (alone,) = chosen(name, data_sets=[SECOND])
    assert alone.data_sets == [SECOND if has else ""]
    assert alone.lines == both.lines
    for key in both.beside:
        assert key in ("fp32", "int8_calibrated") or SECOND in both.lines[key].published
    assert (SECOND in both.published_on) == has


@pytest.mark.parametrize("name", TABLES)
def test_the_lines_of_a_table_take_every_value_of_its_grid_and_no_other(name):
    jobs = [line.job for line in TABLES[name].lines.values()]
    for setting, (usual, *others) in grid(experiment(name)).items():
        assert {usual, *(job[setting] for job in jobs if setting in job)} == {usual, *others}


MINE = """
# @package _global_
hydra:
  mode: MULTIRUN
  sweeper:
    params:
      method.level: 0.25,0.5
      seed: 0,1
table:
  title: Mine
  metrics: [psnr, fps]
"""


def declared(folder: Path, more: str = "", text: str = MINE) -> list[str]:
    (folder / "experiment").mkdir()
    (folder / "experiment/mine.yaml").write_text(f"{text}{more}")
    return [f"--config-dir={folder}"]


def test_a_table_of_ones_own_has_a_line_for_each_job_of_its_grid(tmp_path):
    words = declared(tmp_path)
    assert grid(experiment("mine", words)) == {"method.level": ["0.25", "0.5"], "seed": ["0", "1"]}
    (table,) = chosen("mine", words)
    assert {key: (line.label, line.job) for key, line in table.lines.items()} == {
        x: (f"method.level={x}", {"method.level": x}) for x in ("0.25", "0.5")
    }
    assert table.called == "Mine"
    assert table.name not in [of_paper.name for of_paper in chosen(words=words)]


def test_several_axes_have_a_line_for_each_combination(tmp_path):
    lines = "  label: '{} in {}'\n  lines: {'0.5, b': {published: [30, 20]}}\n"
    two = MINE.replace("seed: 0,1", "method.shade: a,b") + lines
    (table,) = chosen("mine", declared(tmp_path, "  published_on: there\n", two))
    labels = [line.label for line in table.lines.values()]
    assert labels == ["0.25 in a", "0.25 in b", "0.5 in a", "0.5 in b"]
    assert table.lines["0.5, b"].job == {"method.level": "0.5", "method.shade": "b"}
    assert table.lines["0.5, b"].published == {FIRST: {"psnr": 30, "fps": 20, "frame_ms": 50}}
    assert table.lines["0.5, a"].published == {}


def test_what_is_no_text_in_a_job_is_given_as_hydra_reads_it(tmp_path):
    job = "{a: 25, b: null, c: 'x, y', d: plain}"
    (table,) = chosen("mine", declared(tmp_path, f"  lines: {{x: {{job: {job}}}}}"))
    assert table.lines["x"].job == {"a": "25", "b": "null", "c": "'x, y'", "d": "plain"}


def test_a_claim_names_lines_by_keys_that_are_numbers(tmp_path):
    says = (
        "  claims: [{metric: psnr, margin: 0.1, rising: [0.25, 0.5], says: '{0.5} { over {0.25}'}]"
    )
    (table,) = chosen("mine", declared(tmp_path, f"  label: 'v = {{}}'\n{says}"))
    (shown,) = table.shown({})
    assert shown.claims[0].says == "v = 0.5 { over v = 0.25"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("  claim: []", "unknown setting 'experiment mine: table.claim'"),
        ("  lines: {0.75: {label: bright}}", "unknown line '0.75'"),
        ("  lines: {0.5: {job: {method: {level: 2}}}}", "lines.0.5.job: expected"),
        ("  lines: {0.5: {lable: bright}}", "lines.0.5.lable'. Did you mean"),
        ("  lines: {0.5: {published: [30, 1]}}", "published_on: expected what `published` was"),
        (
            "  lines: {0.5: {published: [30]}}\n  published_on: there",
            "lines.published: expected 2 figures, one for each of metrics, got 1",
        ),
        ("  claims: [{metric: psnr, margin: 0.1, rising: [0.5, 1.0]}]", "unknown line '1.0'"),
        (
            "  claims: [{metric: psnr, margin: 0.1, alike: [0.5], says: '{loss}'}]",
            "unknown line 'loss'",
        ),
        ("  claims: [{metric: psrn, margin: 0.1, alike: [0.5]}]", "psrn: no such metric"),
        ("  claims: [{metric: psnr, alike: [0.5]}]", "claims.margin is not set"),
        ("  reference: 1.0", "unknown line '1.0'"),
        ("  instead: {0.5: 1.0}", "unknown line '1.0'"),
        ("  beside: [1.0]", "unknown line '1.0'"),
        ("  lines: []", "expected fields as in docs/extending.md, got AttributeError"),
        ("  label: same", "table.label: expected another for each line, got same"),
        ("  published_on: {Mine: here}", "unknown data set 'Mine'"),
        ("  scenes: [psrn]", "psrn: no such metric"),
        ("  claims: [{metric: fps, margin: 0.1, alike: [0.5]}]", "expected a ratio such as 1.1"),
    ],
)
def test_what_is_wrong_in_a_declaration_is_named(tmp_path, more, said):
    with pytest.raises(SteerbenchError) as error:
        chosen("mine", declared(tmp_path, more))
    assert said in str(error.value)


def test_an_experiment_without_a_table_or_a_grid_is_refused(tmp_path):
    with refusal("demo: table: expected a section"):
        chosen("demo")
    with refusal("expected settings in hydra"):
        chosen("mine", declared(tmp_path, text=MINE.replace("hydra", "hydro")))
