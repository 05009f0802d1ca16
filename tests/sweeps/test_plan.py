"""The jobs of the paper's tables, and the scenes of a data set that they are means over."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from methods.engines import openvino_engine
from sweeps.commands.paper import data_set
from sweeps.data_sets import DATA_SETS, data_sets, find
from sweeps.measurement import described
from sweeps.overrides import composed
from sweeps.plan import Planned, plan, scenes_of
from sweeps.tables import chosen
from tests.common import refusal, write_json

TABLES = {table.name: table for table in chosen()}
"""Their lines alone."""

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]


@cache
def with_one_seed(name: str) -> tuple[Planned, ...]:
    """The jobs of the lines of a table; composing them takes seconds."""
    return tuple(plan(TABLES[name], ["seed=0"]))


@pytest.mark.parametrize("name", TABLES)
def test_every_line_that_can_be_measured_has_its_job(name):
    jobs = with_one_seed(name)
    lines = TABLES[name].lines
    assert [(x.place.line, x.label) for x in jobs] == [(key, x.label) for key, x in lines.items()]
    assert len({job.key for job in jobs}) == len(lines)


@pytest.mark.parametrize(
    ("words", "seeds"),
    [
        *(([f"budget={name}"], [0]) for name in ("tiny", "full")),
        *(([f"budget={name}"], [0, 1, 2]) for name in ("demo", "small", "paper")),
        (["budget=demo", "tables.seeds=2"], [0, 1]),
        (["budget=demo", "seed=7"], [7]),
        (["budget=demo", "seed=1,2"], [1, 2]),
    ],
)
def test_a_budget_says_how_often_lines_are_repeated_unless_seeds_are_asked_for(words, seeds):
    jobs = plan(TABLES["table5"], words)
    assert [job.config.seed for job in jobs] == 2 * seeds


def test_the_field_that_the_papers_method_is_trained_from_is_rendered_with_every_seed():
    seeds = {}
    for job in plan(TABLES["table1"], ["tables.seeds=2"]):
        seeds.setdefault(job.place.line, set()).add(job.config.seed)
    own = {line for line, of in seeds.items() if of == {0, 1}}
    assert {"ngp", "fp32"} <= own <= {"ngp", "fp32", "bf16", "int8", "int8_calibrated"}
    assert seeds["diver"] == {0}


@pytest.mark.parametrize("name", TABLES)
def test_the_lines_of_a_table_of_times_are_measured_in_turns(name):
    jobs = with_one_seed(name)
    timed = {"fps", "frame_ms"} & {*TABLES[name].metrics}
    assert {job.turns == "" for job in jobs} == {not timed}
    assert len({job.turns for job in jobs}) == 1


def test_turns_are_of_one_seed_and_one_scene():
    jobs = plan(TABLES["table2"], ["seed=0,1", "scene=totem,wires"])
    of = {job.turns: (job.config.seed, job.scene) for job in jobs}
    assert len(of) == 4
    assert all(of[job.turns] == (job.config.seed, job.scene) for job in jobs)
    alone = plan(TABLES["table2"], ["seed=0", "scene=totem"])
    assert {job.key for job in alone} <= {job.key for job in jobs}  # found beside wires


def test_the_lines_of_table_3_differ_in_l_alone():
    settings = [described(job.config) for job in with_one_seed("table3")]
    assert len(settings) == 4
    for number, of_line in enumerate(settings):
        method = of_line["method"]
        assert method["rendering"]["range"]["mode"] == "off"
        assert method["model"].pop("frames") == number
    assert all(of_line == settings[0] for of_line in settings)


def test_tables_share_the_run_that_they_have_in_common():
    """But for the tables of times: a time in turns is another figure than one alone."""
    jobs = [
        next(x for x in plan(TABLES[name], ["budget=paper", "seed=0"]) if x.place.line == line)
        for name, line in (("table4", "6"), ("table6", "16"), ("table3", "2"))
    ]
    assert jobs[0].key == jobs[1].key != jobs[2].key
    alone, in_turns = (described(jobs[place].config) for place in (0, 2))
    assert alone == in_turns


def test_both_stages_of_table_5_march_with_the_same_step():
    for job in with_one_seed("table5"):
        assert job.config.method.training.march_step == job.config.method.model.step


def test_what_only_the_tables_read_changes_no_key():
    assert described(composed(["tables.seeds=5"])) == described(composed([]))


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("budgt=tiny", "budgt"),
        ("budget=tiny,demo", "tiny, demo"),
        ("a=b=,", "a=b=,"),
        ("tables.seeds=0", "tables: seeds: expected 1 or more"),
        ("budget.threads=0", "threads: expected 1 or more"),
    ],
)
def test_a_setting_that_cannot_be_had_is_named(override, said):
    with refusal(said):
        plan(TABLES["table3"], [override])


def computed_by(jobs: list[Planned]) -> set[tuple[str, str]]:
    """Engines and their precisions."""
    return {(x.config.engine._target_.rpartition(".")[2], x.config.precision) for x in jobs}


@pytest.mark.parametrize(("gpu", "asked"), [(False, []), (True, []), (False, ["engine=torch"])])
def test_the_engine_of_the_first_table_is_one_for_device_and_precision(gpu, asked, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    jobs = plan(TABLES["table1"], asked)
    engines = {engine for engine, _ in computed_by(jobs)}
    assert engines == {"TorchEngine" if gpu or asked else "OpenVino"}


@pytest.mark.parametrize(
    ("cpu", "computed"),
    [(["FP32", "BF16"], ("OpenVino", "bf16")), (["FP32"], ("OpenVino", "fp32"))],
)
@pytest.mark.parametrize("name", ["table2", "table3"])
def test_tables_of_times_are_in_half_precision_where_the_cpu_has_it(
    name, cpu, computed, monkeypatch
):
    monkeypatch.setattr(openvino_engine, "_capabilities", lambda openvino: cpu)
    jobs = plan(TABLES[name], ["seed=0", "device=cpu"])
    assert computed_by(jobs) == {computed}
    asked = computed_by(plan(TABLES[name], ["seed=0", "precision=fp32"]))
    assert {precision for _, precision in asked} == {"fp32"}


# Scenes and data sets


def test_a_scene_is_compared_with_the_figures_of_its_data_set():
    """Embedded scenes are compared with the first data set, unless they stand in for another."""
    words = ["scene=totem_hd,totem", "scene.downscale=2", "budget=paper", "seed=0"]
    scenes = scenes_of(words)
    assert data_sets(scenes) == ["NeRF-Synthetic", "Tanks & Temples"]
    tables = {table.name: table for table in chosen(data_sets=data_sets(scenes))}
    jobs = plan(tables["table1"], words)
    for job in jobs:
        assert job.config.scene.height == {"totem": None, "totem_hd": 1080}[job.scene]
        assert job.config.scene.downscale == 2
    of_scene = zip(DATA_SETS, ["totem", "totem_hd"], strict=True)
    assert {(job.place.block, job.scene) for job in jobs} == {*of_scene}
    lines = {job.place.line for job in jobs if job.scene == "totem_hd"}
    assert lines == set(tables["table1"].beside)
    assert len(lines) == 4
    assert {job.scene for job in plan(tables["table5"], words)} == {"totem"}


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ([], [""]),
        (["scene=totem"], ["totem"]),
        (["scene=totem,wires", "seed=1"], ["totem", "wires"]),
        (["scene=nsvf", "scene.path=/data/Barn"], ["Barn"]),
        (["scene=nsvf", "scene.path='/my data/Barn'"], ["Barn"]),
    ],
)
def test_a_scene_is_known_by_its_choice_or_its_folder(words, found):
    assert scenes_of(words) == found
    assert data_sets(["Barn"]) == data_sets(["Truck", "Barn"]) == ["Tanks & Temples"]


def blender(folder: Path, value: int = 255, pictures: bool = True) -> Path:
    """A scene in the layout of NeRF-Synthetic: two pictures of 16 x 16 of one value a split."""
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
        names = [f"./{split}/r_{number}" for number in range(2)]
        frames = [{"file_path": name, "transform_matrix": POSE} for name in names]
        record = {"camera_angle_x": 0.7, "frames": frames}
        write_json(folder / f"transforms_{split}.json", record)
        for name in names if pictures else ():
            picture = np.full((16, 16, 3), value, np.uint8)
            Image.fromarray(picture).save(folder / f"{name}.png")
    return folder


def nsvf(folder: Path, pictures: bool = True) -> Path:
    """A scene in NSVF's layout, as far as its names show."""
    for name in ("rgb", "pose"):
        (folder / name).mkdir(parents=True)
    (folder / "bbox.txt").touch()
    if pictures:
        (folder / "rgb/0_00000.png").touch()
    return folder


def test_of_nerf_synthetic_what_is_there_is_found_and_the_rest_is_named(tmp_path):
    for name in ("mic", "lego"):
        blender(tmp_path / name)
    blender(tmp_path / "chair", pictures=False)
    (tmp_path / "lego/test/r_1.png").unlink()
    (tmp_path / "drums").mkdir()
    found = find(str(tmp_path))
    assert (found.layout, list(found.scenes)) == ("blender", ["mic"])
    assert found.missing == {
        "chair": "no pictures",
        "drums": "no transforms_train.json or bbox.txt",
        "lego": "1 of 4 pictures are not there",
        **dict.fromkeys(("ficus", "hotdog", "materials", "ship"), "no folder"),
    }


def test_of_tanks_and_temples_too_and_scenes_of_ones_own_miss_nothing(tmp_path):
    for name in ("Barn", "Truck"):
        nsvf(tmp_path / name)
    nsvf(tmp_path / "Family", pictures=False)
    found = find(str(tmp_path))
    assert (found.layout, list(found.scenes)) == ("nsvf", ["Barn", "Truck"])
    assert set(found.missing) == {"Caterpillar", "Family", "Ignatius"}
    blender(tmp_path / "mine/teapot")
    assert find(str(tmp_path / "mine")).missing == {}


@pytest.mark.parametrize(
    ("folder", "said"),
    [
        ("empty", r"got none.*scene\.path"),
        ("both/mic", r"got none.*scene\.path"),  # a scene itself
        ("both", "scenes of both: Barn, mic"),
    ],
)
def test_no_scenes_or_those_of_two_layouts_have_no_mean(tmp_path, folder, said):
    (tmp_path / "empty").mkdir()
    blender(tmp_path / "both/mic")
    nsvf(tmp_path / "both/Barn")
    with refusal(said):
        find(str(tmp_path / folder))


@pytest.mark.parametrize("word", ["scene=totem", "scene.path=elsewhere", "++scene.path=elsewhere"])
def test_a_scene_beside_a_data_set_is_refused(tmp_path, word):
    blender(tmp_path / "mic")
    with refusal("expected one of them"):
        data_set([word, f"data={tmp_path}"])
    assert data_set([word]) == ([word], None)


@pytest.mark.parametrize("quote", ["", "'", '"'])
def test_every_scene_is_a_job_of_its_own_and_a_command_that_makes_it(tmp_path, quote):
    for name in ("mic", "chair"):
        blender(tmp_path / "my data" / name)
    folder = f"{quote}{tmp_path / 'my data'}{quote}"
    typed = ["scene.downscale=4", f"data={folder}", "budget=tiny", "seed=0,1"]
    words, data = data_set(typed)
    assert words == [typed[0], *typed[2:]]
    jobs = plan(TABLES["table5"], words, data)
    assert {job.config.scene.downscale for job in jobs} == {4}
    cells = [(job.scene, job.config.seed) for job in jobs]
    assert cells == 2 * [("chair", 0), ("mic", 0), ("chair", 1), ("mic", 1)]
    assert len({job.key for job in jobs}) == len(jobs)
    for job in jobs:
        again = composed([text for text in job.command[2:] if text != "hydra.mode=RUN"])
        assert described(again) == described(job.config)
        assert again.scene.path == str(tmp_path / "my data" / job.scene)
    assert jobs[0].name.endswith(", chair, seed 0")
