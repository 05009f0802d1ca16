"""Mistyped overrides: one line that names what was typed, the nearest names, and what exists."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("argument", "kind", "typed", "nearest"),
    [
        ("method=gery", "method", "gery", "grey"),
        ("scene=blendr", "scene", "blendr", "blender"),
        ("budgt=none", "setting", "budgt", "budget"),
        ("sed=1", "setting", "sed", "seed"),
        ("method.lvl=1", "setting", "method.lvl", "method.level"),
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


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("~nothing", "'nothing' does not exist"),
        *((word, "") for word in ("budget=0.0", "~budget=0.0", "scene=null", "~seed", "~method")),
    ],
)
def test_what_is_no_choice_or_not_there_is_an_error_without_traceback(run, argument, said):
    outcome = run(argument)
    assert outcome.status == 2
    assert outcome.err.startswith("steerbench: ")
    assert said in outcome.err
    assert "Traceback" not in outcome.err
