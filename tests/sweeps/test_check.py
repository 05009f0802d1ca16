"""`steerbench check` and `compare`: exit statuses, what is missing, files that are no baseline."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from bench.errors import SteerbenchError
from bench.results import Store
from sweeps.cli import dispatch
from tests.reports.conftest import rewrite


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
    ((figures,),) = (seeds.values() for seeds in held["runs"].values())
    figures["values"]["psnr"] += 1
    figures["frames"]["psnr"] = {name: x + 1 for name, x in figures["frames"]["psnr"].items()}
    baseline.write_text(json.dumps(held))
    assert check(baseline, outputs) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "psnr" in line]
    assert "-1" in line
    assert "worse" in line


def test_a_baseline_that_is_recorded_anew_keeps_its_limits_and_its_runs(baseline, outputs):
    held = json.loads(baseline.read_text())
    held["limits"] = {"psnr": {"better": 1, "absolute": 0.5}}
    baseline.write_text(json.dumps(held))
    assert check(baseline, outputs, "--record") == 0
    again = json.loads(baseline.read_text())
    assert again["limits"]["psnr"]["absolute"] == 0.5
    assert again["runs"].keys() == held["runs"].keys()
    assert list(again["runs"]["method=offset scene=tiny"]["5"]["values"]) == ["psnr"]


def test_a_run_of_other_frames_fails_and_the_others_are_still_compared(baseline, outputs, capsys):
    held = json.loads(baseline.read_text())
    ((command, seeds),) = held["runs"].items()
    others = {"5": {**seeds["5"], "views": "others"}}
    held["runs"] = {command: others, "method=other": seeds}
    baseline.write_text(json.dumps(held))
    assert check(baseline, outputs) == 1
    out = capsys.readouterr().out
    assert f"{command}: these are figures of other frames" in out
    assert "method=other: no such run" in out


@pytest.mark.parametrize("text", [None, "", "{}", '{"schema": 99}'])
def test_what_is_no_baseline_is_refused_with_the_way_to_make_one(text, outputs, tmp_path):
    path = tmp_path / "none.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(SteerbenchError, match=r"no baseline .*check --record"):
        check(path, outputs)


@pytest.fixture
def copy(outputs: Path, stored_run: str) -> Path:
    """The folder of a second run beside the first, as yet the same."""
    folder = outputs / "runs" / f"0{stored_run[1:]}"
    return shutil.copytree(outputs / "runs" / stored_run, folder)


def test_all_seeds_of_a_run_are_one_entry_and_none_may_be_missing(outputs, copy, tmp_path, capsys):
    rows = pd.read_csv(copy / "rows.csv").assign(seed=6, run=copy.name)
    rows.loc[rows["metric"] == "psnr", "value"] += 1
    rows.to_csv(copy / "rows.csv", index=False)
    path = tmp_path / "baseline.json"
    assert check(path, outputs, "--record") == 0
    (seeds,) = json.loads(path.read_text())["runs"].values()
    assert seeds.keys() == {"5", "6"}
    assert seeds["6"]["values"]["psnr"] == pytest.approx(seeds["5"]["values"]["psnr"] + 1)
    assert check(path, outputs) == 0
    assert "as good as the baseline" in capsys.readouterr().out
    shutil.rmtree(copy)
    assert check(path, outputs) == 1
    assert "scene=tiny: no such run with seed=6 below" in capsys.readouterr().out


def test_a_run_of_another_schema_is_left_out_and_not_compared(baseline, outputs, stored_run, copy):
    rewrite(Store(outputs), copy.name, schema_version=1)
    assert check(baseline, outputs) == 0
    with pytest.raises(SteerbenchError, match=rf"{copy.name}: stored by another .* \(schema 1,"):
        dispatch(["compare", copy.name, stored_run, "--outputs", str(outputs)])
