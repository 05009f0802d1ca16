"""`steerbench check` and `compare`: exit statuses, what is missing, files that are no baseline."""

import json
import math
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import pandas as pd
import pytest

from bench.errors import SteerbenchError
from bench.results import Store
from sweeps.baseline import Entry, portable
from sweeps.cli import dispatch
from sweeps.measurement import Job
from sweeps.overrides import composed
from tests.reports.conftest import copied, rewrite
from tests.sweeps.conftest import HERE, QUICK


@pytest.fixture
def outputs(store: Store, stored_run: str) -> Path:
    """A folder of outputs with one run that says how it was made."""
    command = "steerbench run scene=tiny method=offset outputs=somewhere"
    rewrite(store, stored_run, command=command)
    return store.folder.parent


def check(baseline: Path, outputs: Path, *more: str) -> int:
    return dispatch(["check", str(baseline), "--outputs", str(outputs), *more])


@pytest.fixture
def baseline(outputs: Path, tmp_path: Path) -> Path:
    path = tmp_path / "baseline.json"
    assert check(path, outputs, "--record") == 0
    return path


def test_a_figure_that_became_worse_is_shown_and_fails(baseline, outputs, capsys):
    held = json.loads(baseline.read_text())
    (figures,) = held["runs"][0]["seeds"].values()
    figures["values"]["psnr"] += 1
    figures["frames"]["psnr"] = {name: x + 1 for name, x in figures["frames"]["psnr"].items()}
    baseline.write_text(json.dumps(held))
    assert check(baseline, outputs) == 1
    line, last = [line for line in capsys.readouterr().out.splitlines() if "psnr" in line]
    assert "-1" in line
    assert "| 0.1 | worse |" in line
    assert last.startswith("worse: psnr -1 dB (limit 0.1): offset, scene tiny; ")


def test_a_baseline_that_is_recorded_anew_keeps_its_limits_and_its_runs(baseline, outputs):
    held = json.loads(baseline.read_text())
    held["limits"] = {"psnr": {"better": 1, "absolute": 0.5}}
    baseline.write_text(json.dumps(held))
    assert check(baseline, outputs, "--record") == 0
    again = json.loads(baseline.read_text())
    assert again["limits"]["psnr"]["absolute"] == 0.5
    (run,) = again["runs"]
    assert run["command"] == "run scene=tiny method=offset"
    assert list(run["seeds"]["5"]["values"]) == ["psnr"]
    assert check(baseline, outputs, "--record", "--limit", "ssim=1%") == 0
    assert json.loads(baseline.read_text())["limits"].keys() == {"psnr", "ssim"}


def test_a_run_of_other_frames_fails_and_the_others_are_still_compared(baseline, outputs, capsys):
    held = json.loads(baseline.read_text())
    (run,) = held["runs"]
    others = {"5": {**run["seeds"]["5"], "views": "others"}}
    other = {**run, "subject": ["other", *run["subject"][1:]], "command": "run method=other"}
    held["runs"] = [{**run, "seeds": others}, other]
    baseline.write_text(json.dumps(held))
    assert check(baseline, outputs) == 1
    out = capsys.readouterr().out
    assert "these are figures of other frames" in out
    assert f"no such run below {outputs}: run method=other" in out
    assert "peak_bytes: other, scene tiny; 0 of " in out


@pytest.mark.parametrize("text", [None, "", "{}", '{"schema": 99}'])
def test_what_is_no_baseline_is_refused_with_the_way_to_make_one(text, outputs, tmp_path):
    path = tmp_path / "none.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(SteerbenchError, match=r"no baseline: .*check --record"):
        check(path, outputs)


def test_a_damaged_baseline_is_refused_by_the_place(baseline, outputs):
    text = baseline.read_text()
    for old, new, said in (
        ('"absolute"', '"absolut"', "limits.psnr: expected fields of better, absolute,"),
        ('"psnr": {', '"psnrr": {', "unknown metric 'psnrr'. Did you mean psnr"),
        ('"views": "', '"views": 5, "x": "', r"runs\[0\].seeds.5: expected fields of values,"),
        ('"values": {', '"values": 5, "frames": {', r"seeds.5.values: expected Mapping"),
    ):
        baseline.write_text(text.replace(old, new, 1))
        with pytest.raises(SteerbenchError, match=rf"no baseline: .*{said}.*check --record"):
            check(baseline, outputs)


@pytest.fixture
def copy(outputs: Path, stored_run: str) -> Path:
    """The folder of a second run beside the first, as yet the same."""
    return copied(Store(outputs), stored_run, f"0{stored_run[1:]}")


def test_all_seeds_of_a_run_are_one_entry_and_none_may_be_missing(outputs, copy, tmp_path, capsys):
    rows = pd.read_csv(copy / "rows.csv").assign(seed=6)
    rows.loc[rows["metric"] == "psnr", "value"] += 1
    rows.to_csv(copy / "rows.csv", index=False)
    rewrite(Store(outputs), copy.name, command="steerbench run scene=tiny method=offset seed=6")
    path = tmp_path / "baseline.json"
    assert check(path, outputs, "--record") == 0
    (run,) = json.loads(path.read_text())["runs"]
    seeds = run["seeds"]
    assert seeds.keys() == {"5", "6"}
    assert seeds["6"]["values"]["psnr"] == pytest.approx(seeds["5"]["values"]["psnr"] + 1)
    assert check(path, outputs) == 0
    assert "as good as the baseline" in capsys.readouterr().out
    shutil.rmtree(copy)
    assert check(path, outputs) == 1
    assert "no such run with seed=6 below" in capsys.readouterr().out


def test_a_run_of_another_schema_is_left_out_and_not_compared(baseline, outputs, stored_run, copy):
    rewrite(Store(outputs), copy.name, schema_version=1)
    assert check(baseline, outputs) == 0
    with pytest.raises(SteerbenchError, match=rf"{copy.name}: stored by another .* \(schema 1,"):
        dispatch(["compare", copy.name, stored_run, "--outputs", str(outputs)])


def test_what_a_record_leaves_out_is_said(outputs, copy, tmp_path, capsys):
    rewrite(Store(outputs), copy.name, schema_version=1)
    Job(composed([f"outputs={outputs}"]), []).keep_failure(MemoryError("no room"))
    assert check(tmp_path / "baseline.json", outputs, "--record") == 0
    out = capsys.readouterr().out
    assert "without a limit: fps, frame_ms.*, " in out
    assert "left out: a run that failed: no room" in out
    assert f"left out: {copy.name}: stored by another version" in out


def test_a_folder_that_is_no_store_is_an_error_of_every_command(steerbench, baseline):
    own = ("results", "compare 0 1", "check baseline.json", "check --record new.json")
    commands = [f"{x} --outputs nowhere" for x in own]
    of_settings = ("report --table table3", "render --run 0")
    commands += [f"{x} outputs=nowhere" for x in of_settings]
    for said in ("there is no store of runs", "no runs to read"):
        for command in commands:
            refused = steerbench(*command.split()).refused()
            assert f"steerbench: nowhere: {said}; `steerbench run outputs=nowhere`" in refused
        Path("nowhere/runs").mkdir(parents=True, exist_ok=True)


def held_of(baseline: Path) -> dict:
    """What a baseline of one run with the seed 5 holds."""
    held = json.loads(baseline.read_text())
    return {**held, "values": held["runs"][0]["seeds"]["5"]["values"]}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda held: held["runs"].clear(), "runs: expected some, as a list, got none"),
        (lambda held: held["limits"].clear(), "limits: expected some, as a dict, got none"),
        (lambda held: held["values"].clear(), "values: expected figures with a limit, got none"),
        (
            lambda held: held["values"].update(psnr=math.nan),
            "psnr: expected a finite number, got nan",
        ),
        (lambda held: held["values"].update(psnr=-math.inf), "finite number, got -inf"),
        (lambda held: held["values"].update(frame_ms=math.inf), "finite number, got inf"),
        (lambda held: held["values"].update(psnr=10**400), "finite number, got 1000000"),
        (lambda held: held["limits"]["psnr"].update(absolute=math.nan), "finite number, got nan"),
        (lambda held: held["limits"]["psnr"].update(relative=math.inf), "finite number, got inf"),
        (lambda held: held["limits"]["psnr"].update(better=-1), "better: expected 1, got -1"),
        (lambda held: held["limits"]["flicker"].update(better=0), "better: expected -1, got 0"),
    ],
)
def test_a_baseline_that_compares_nothing_is_refused(baseline, outputs, change, said):
    held = held_of(baseline)
    change(held)
    del held["values"]
    baseline.write_text(json.dumps(held))
    with pytest.raises(SteerbenchError, match=f"no baseline: .*{said}"):
        check(baseline, outputs)


def test_a_metric_that_one_seed_of_a_baseline_lacks_is_missing(outputs, copy, tmp_path, capsys):
    rows = pd.read_csv(copy / "rows.csv").assign(seed=6)
    rows.to_csv(copy / "rows.csv", index=False)
    rewrite(Store(outputs), copy.name, command="steerbench run scene=tiny method=offset seed=6")
    path = tmp_path / "baseline.json"
    assert check(path, outputs, "--record") == 0
    held = json.loads(path.read_text())
    del held["runs"][0]["seeds"]["5"]["values"]["ssim"]
    path.write_text(json.dumps(held))
    assert check(path, outputs) == 1
    assert "missing: ssim: offset" in capsys.readouterr().out


def test_a_run_of_which_nothing_can_be_compared_is_missing(outputs, stored_run, tmp_path, capsys):
    path = tmp_path / "baseline.json"
    assert check(path, outputs, "--record") == 0
    held = json.loads(path.read_text())
    held["limits"] = {"frame_ms": held["limits"]["frame_ms"]}
    (of_seed,) = held["runs"][0]["seeds"].values()
    of_seed |= {"values": {"frame_ms": 1.0}, "frames": {}, "machine": "another"}
    path.write_text(json.dumps(held))
    assert check(path, outputs) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("missing: every metric: offset, scene tiny; 0 of 1 figures")
    assert last.endswith("before on another")


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("run", "run", True),  # both of the default, which changed
        ("run method.level=0.5", "run", False),
        ("run", "run method.level=0.25", False),
        ("run budget=tiny", "run budget=tiny", True),
        ("run budget=tiny", "run", True),  # the default by now: its settings are equal
        ("run method=grey", "run", False),  # the choice brought a setting that differs
        ("run +experiment=own", "run", False),  # nobody knows what it brought
    ],
)
def test_only_a_default_that_changed_is_forgiven(old, new, same):
    one, other = (
        Entry(["grey"], command, {"method.level": level, "budget.steps": "3"}, {})
        for command, level in ((old, "0.5"), (new, "0.25"))
    )
    assert one.same(other) == other.same(one) == same
    assert one.same(Entry(["grey"], new, one.settings, {}))  # however it was typed
    assert not one.same(Entry(["black"], new, one.settings, {}))


def test_of_several_defaults_those_used_last_are_compared():
    """A stored run of the old default is no reason to pass."""
    recorded, old, new = (
        Entry(["grey"], "run", {"method.level": level}, {}) for level in ("0.5", "0.5", "0.25")
    )
    assert recorded.nearest([new, old], [recorded]) is new
    assert recorded.nearest([old, new], [recorded]) is old


def test_scenes_that_only_their_folders_tell_apart_are_refused(outputs, copy, tmp_path):
    rewrite(Store(outputs), copy.name, scene={"digest": "other"}, scene_path="/v1/views.npz")
    with pytest.raises(SteerbenchError, match="which a baseline knows as one by the last parts"):
        check(tmp_path / "baseline.json", outputs, "--record")


@pytest.mark.parametrize("known_by", ["job", "command"])
def test_no_run_stands_for_code_that_fails(baseline, outputs, stored_run, capsys, known_by):
    word = f"outputs={outputs}"
    command = ["steerbench", "run", "method=offset", "scene=tiny", "seed=5", word]
    failed = Job(composed([word]), command if known_by == "command" else [])
    if known_by == "job":
        Store(outputs).use(stored_run, failed.key)
    assert check(baseline, outputs) == 0
    failed.keep_failure(RuntimeError("it diverged"))
    assert check(baseline, outputs) == 1
    assert "failed with it diverged: run scene=tiny method=offset" in capsys.readouterr().out


# A gate for other checkouts


@pytest.fixture
def gate(steerbench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Measure a method of a checkout, whose YAML says `level`, and check it there with words."""

    def called(checkout: str, *words: str, level: float = 0.5):
        shutil.copytree(HERE / "configs", tmp_path / checkout / "configs", dirs_exist_ok=True)
        monkeypatch.chdir(tmp_path / checkout)
        method = Path("configs/method/grey.yaml")
        method.write_text(method.read_text().replace("level: 0.5", f"level: {level}"))
        steerbench("run", "--config-dir", "configs", *QUICK, "-m", "seed=0,1").ok()
        return steerbench("check", "../baseline.json", *words)

    called("one", "--record", "--limit", "frame_ms=99999%", "--limit", "peak_bytes=999%").ok()
    return called


def test_a_gate_passes_in_a_checkout_elsewhere_with_a_method_of_its_own(gate, tmp_path):
    assert str(tmp_path) not in Path("../baseline.json").read_text()
    assert (
        gate("two")
        .ok()
        .out.endswith("as good as the baseline; 6 of 6 figures of 1 runs compared\n")
    )


def test_a_setting_that_makes_it_worse_fails_and_every_form_names_the_metrics(gate, monkeypatch):
    summary = Path("summary.md").absolute()
    summary.write_text("before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    failed = gate("two", "--markdown", str(summary), "--junit", "junit.xml", level=0.25)
    last = failed.out.splitlines()[-1]
    assert failed.status == 1
    assert "defaults that changed: method.level=0.25 (was 0.5)" in failed.out
    assert last.startswith("worse: psnr -3.54 dB (limit 0.1), ssim -0.")
    assert " (limit 0.002): grey, scene white; 6 of 6 figures of 1 runs compared" in last
    assert summary.read_text().startswith(f"before\n## steerbench check\n\n{last}\n\n### grey")
    cases = ET.parse("junit.xml").getroot()
    worse = [case.attrib["name"] for case in cases if case.find("failure") is not None]
    shown = json.loads(gate("two", "--json", "-", level=0.25).out)
    assert worse == [x["metric"] for x in shown if x["verdict"] == "worse"] == ["psnr", "ssim"]
    assert len(cases) == len(shown)


def test_an_absolute_path_is_known_by_its_last_part():
    typed = "/a/worker.py --model=~/b/c.ply x/y http://host/d ['/e/f', 1]"
    assert portable(typed) == "worker.py --model=c.ply x/y http://host/d ['f', 1]"
