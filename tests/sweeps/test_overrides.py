"""Mistyped overrides: one line that names what was typed, the nearest names, and what exists."""

from __future__ import annotations

from pathlib import Path

import pytest

from sweeps.overrides import composed


@pytest.mark.parametrize(
    ("argument", "kind", "typed", "nearest"),
    [
        ("method=gery", "method", "gery", "grey"),
        ("scene=blendr", "scene", "blendr", "blender"),
        ("budgt=none", "setting", "budgt", "budget"),
        ("sed=1", "setting", "sed", "seed"),
        ("+experiment=dmo", "experiment", "dmo", "demo"),
        ("trajectory.limt=2", "setting", "trajectory.limt", "trajectory.limit"),
        ("+scene.fraems=2", "setting", "scene.fraems", "scene.frames"),
    ],
)
def test_an_unknown_name_comes_with_the_nearest_one(run, argument, kind, typed, nearest):
    outcome = run(argument)
    assert outcome.status == 2
    assert outcome.out == ""
    assert outcome.err.startswith(f"steerbench: unknown {kind} '{typed}'. Did you mean {nearest}")
    assert outcome.err.count("\n") == 1


def test_settings_of_the_chosen_scene_are_among_the_suggestions(steerbench):
    outcome = steerbench("run", "scene=blender", "scene.path=x", "scene.downscal=2")
    assert "Did you mean scene.downscale?" in outcome.err


def test_the_field_of_a_method_is_not_chosen_for_another(steerbench):
    outcome = steerbench("run", "method=steernerf", "field=nerf")
    assert outcome.status == 2
    assert outcome.err.startswith("steerbench: field: each method brings its own")


@pytest.mark.parametrize("argument", ["demo", "a=b=c", "scene.path=["])
def test_what_is_no_override_is_quoted_with_an_example(run, argument):
    outcome = run(argument)
    assert outcome.status == 2
    assert f"cannot read '{argument}'" in outcome.err
    assert "key=value" in outcome.err


def test_a_setting_without_default_is_asked_for(run):
    outcome = run("scene=blender")
    assert outcome.err == "steerbench: scene.path is not set: give scene.path=...\n"


def test_deleting_what_is_not_there_is_an_error_without_traceback(run):
    outcome = run("~nothing")
    assert outcome.status == 2
    assert "'nothing' does not exist" in outcome.err
    assert "Traceback" not in outcome.err


@pytest.mark.parametrize(
    "argument", ["budget=0.0", "~budget=0.0", "scene=null", "~seed", "~method"]
)
def test_a_choice_that_is_no_name_or_none_is_an_error_without_traceback(run, argument):
    outcome = run(argument)
    assert outcome.status == 2
    assert outcome.err.startswith("steerbench: ")
    assert "Traceback" not in outcome.err


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["run", "method=steernerf_paper"], "use method=steernerf"),
        (["skips", "method=steernerf_paper"], "use method=steernerf"),
        (["run", "method=steernerf_untaught"], "use method=steernerf_lean with"),
        (["run", "-m", "method=ngp,ngp_guided"], "was removed; its figures are in docs/log.md"),
        (["accuracy", "renderer@method.renderer=s2d"], "use renderer=lean"),
        (["parity", "renderer@method.renderer=unet_release"], "use renderer=unet"),
        (["run", "protocol=steerbench-1-lookahead"], "was removed; its figures"),
        (["run", "protocol.lookahead=true"], "'protocol.lookahead' was removed"),
        (["run", "method=steernerf", "method.pipeline.frames=3"], "use method.model.frames"),
        (["report", "method.pipeline.range.mode=off"], "use method.rendering.range.mode"),
        (["skips", "method.pipeline.steps=1"], "use method.model.step, or method.rendering.step"),
        (["skips", "method.pipeline.refresh.age=3"], "'method.pipeline.refresh.age' was removed"),
        (["skips", "method.pipeline.depth=3"], "use method.model, or method.rendering for"),
        (["generic", "--output", "w"], "command 'generic' was renamed; use steerbench pretrain"),
    ],
)
def test_an_old_name_is_answered_with_the_new_one(steerbench, argv, said):
    outcome = steerbench(*argv)
    assert outcome.status == 2
    assert said in outcome.err
    assert outcome.err.count("\n") == 1


def test_a_name_that_was_removed_may_be_used_again_by_a_plug_in(tmp_path: Path) -> None:
    folder = tmp_path / "method"
    folder.mkdir()
    (folder / "ngp_guided.yaml").write_text("defaults: [ngp, _self_]\nname: other\n")
    assert composed(["method=ngp_guided", f"--config-dir={tmp_path}"]).method.name == "other"
