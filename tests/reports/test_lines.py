"""Runs as lines: seeds are repetitions, and settings that differ are columns."""

from dataclasses import replace

import pytest

from reports.comparison import columns_of, comparison
from reports.lines import as_lines, results, seedless
from tests.reports.conftest import rename, rewrite, run_of

FACTS = dict.fromkeys(("scene", "split", "trajectory", "budget", "protocol", "device"), "same")
FACTS |= {"method": "m", "engine": "none", "precision": "none", "seed": 0}
PLACE = {"machine": {"cpu": "EPYC", "threads": 2, "gpus": []}, "scene": {"digest": "d"}}


@pytest.fixture
def make(rows):
    """Makes a run of a method with settings and a seed; `facts` are those of its rows."""

    def make_run(settings, seed=0, psnr=30.0, typed="", **facts):
        own = rows.assign(**{**FACTS, "seed": seed, **facts})
        own.loc[own["metric"] == "psnr", "value"] = psnr
        name = own["method"].iloc[0]
        config = {"seed": seed, "method": {"name": name, "seed": seed, **settings}}
        axes = {"method.frames": "L"}
        command = f"steerbench run {typed}"
        return run_of(own, name, made_of={"config": config}, axes=axes, command=command, **PLACE)

    return make_run


def test_runs_that_differ_in_their_seed_make_one_line_with_mean_and_interval(make):
    runs = [make({"frames": n}, seed, 30 + n + seed) for n in (0, 2) for seed in (0, 1)]
    lines = as_lines(runs)
    assert [line.label for line in lines.lines] == ["L=0", "L=2"]
    table = lines.frame(["psnr"])
    assert table[["method", "L", "seeds", "psnr"]].to_numpy().tolist() == [
        ["m", "0", 2, 30.5],
        ["m", "2", 2, 32.5],
    ]
    assert table["psnr.half"].tolist() == pytest.approx([6.353] * 2, rel=1e-3)  # t(1) / 2
    (shown,) = comparison(lines, {"m (L=3)": "no memory"})
    assert shown.columns[:4] == ("method", "L", "seeds", "PSNR, dB ↑")
    assert shown.lines[0][:4] == ("m", "0", "2", "30.50 ± 6.35")
    assert shown.lines[2][:2] == ("m (L=3): failed: no memory", "")


def test_what_follows_from_a_column_is_none_unless_it_was_typed(make):
    both = {"frames": 1, "log2_table": 12}, {"frames": 2, "log2_table": 14}
    assert list(as_lines(list(map(make, both))).settings) == ["method", "L"]
    typed = [make(of, typed="method.log2_table=1 method.frames=1") for of in both]
    assert as_lines(typed).settings == {
        "method": ["m", "m"], "L": ["1", "2"], "log2_table": ["2^12", "2^14"]
    }  # fmt: skip


def test_settings_are_compared_within_a_method_and_facts_across_methods(make):
    runs = [make({"frames": 1}), make({"width": 16}, method="other", engine="openvino")]
    assert as_lines(runs).settings == {"method": ["m", "other"], "engine": ["none", "openvino"]}
    runs += [make({"width": 64}, method="other", engine="openvino")]
    assert as_lines(runs).settings["width"] == ["", "16", "64"]


def test_the_same_settings_on_other_machines_are_lines_of_their_own(make):
    runs = [make({}), replace(make({}), record={**make({}).record, "machine": {
        "cpu": "Xeon", "threads": 2, "gpus": []}})]  # fmt: skip
    lines = as_lines(runs)
    assert len(lines.lines) == 2
    assert lines.settings["machine"] == ["same, EPYC, 2 threads", "same, Xeon, 2 threads"]


def test_a_line_whose_seeds_are_all_alike_is_known(make):
    alike = [make({"frames": 0}, seed) for seed in range(3)]
    others = [make({"frames": 2}, seed, 30 + seed) for seed in range(3)]
    assert seedless(as_lines([*alike, *others])) == ["L=0"]
    assert seedless(as_lines(alike[:1])) == []


def test_a_seed_counts_once_in_a_line(make):
    runs = [make({}), make({})]
    runs[1].record["made_of"]["config"]["pictures"] = 3
    ((line,), several) = as_lines(runs).lines, as_lines([*runs, make({}, seed=1)]).lines[0]
    assert [len(line.runs), len(several.runs)] == [1, 2]


def test_a_setting_that_is_called_as_a_column_keeps_its_whole_name(make):
    for own in ("method", "seeds", "frames", "fps", "psnr"):
        (name,) = as_lines([make({"of": {own: n}}) for n in (0, 5)]).settings.keys() - {"method"}
        assert name == f"method.of.{own}"


def test_runs_that_differ_in_no_setting_have_their_commits_and_times(several):
    store, keys = several
    first, second, *others = keys
    for key in others:
        store.remove(key)
    for key, commit in ((first, "one"), (second, "one-dirty")):
        rename(store, key, "m")
        rewrite(store, key, repositories={"odd": commit}, stored=0.0, made_of={"config": {}})
    rows = results(store)
    versions = rows.groupby("run")["version"].unique()
    for key, commit in ((first, "one"), (second, "one-dirty")):
        (said,) = versions[key]
        assert f", odd {commit}, 19" in said  # the time is local
    store.remove(second)
    assert "version" not in results(store)


def test_of_no_runs_the_usual_columns_are_left():
    assert columns_of(as_lines([])) == ["frame_ms", "fps", "size_bytes.total", "train_s"]
