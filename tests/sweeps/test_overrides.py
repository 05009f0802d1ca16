"""Wrong settings: one line that names what was typed, the nearest names, and what exists."""

import pytest

UNKNOWN = [
    ("method=gery", "method", "gery", "grey"),
    ("budgt=none", "setting", "budgt", "budget"),
    ("method.lvl=1", "setting", "method.lvl", "method.level"),
    ("+experiment=dmo", "experiment", "dmo", "demo"),
    ("+scene.fraems=2", "setting", "scene.fraems", "scene.frames"),
    ("scene=blender scene.downscal=2", "setting", "scene.downscal", "scene.downscale"),
]
"""Words, the kind of the name that does not exist, the name, and a near one."""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        *((words, f"unknown {kind} '{typed}'. Did you mean {near}")
          for words, kind, typed, near in UNKNOWN),
        *((word, f"cannot read '{word}': settings are written key=value")
          for word in ("demo", "a=b=c", "scene.path=[")),
        ("method=steernerf field=nerf", "field: each method brings its own"),
        ("scene=blender", "scene.path is not set: give scene.path=...\n"),
        ("method.level=7", "method.level: expected 0 to 1, got 7\n"),
        ("split=holdout", "split: expected test or validation, got 'holdout'\n"),
        ("seed=one", "seed: expected int, got 'one'\n"),
        ("seed=-1", "seed: expected 0 or more, below 2^63, got -1\n"),
        ("threads=0", "threads: expected 1 or more, or null, got 0\n"),
        ("device=gpu", "device: expected auto, cpu, cuda or cuda:N, got gpu\n"),
        ("budget.steps=true", "budget.steps: expected int, got True\n"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_in_one_line(run, tmp_path, words, said):
    outcome = run(*words.split())
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err.startswith(f"steerbench: {said}")
    assert outcome.err.count("\n") == 1
    assert list(tmp_path.glob("outputs/runs/*")) == []


@pytest.mark.parametrize(
    "word", ["~nothing", "budget=0.0", "~budget=0.0", "scene=null", "~seed", "~method"]
)
def test_what_is_no_choice_or_not_there_is_an_error_without_traceback(run, word):
    outcome = run(word)
    assert outcome.status == 2
    assert outcome.err.startswith("steerbench: ")
    assert word != "~nothing" or "'nothing' does not exist" in outcome.err
    assert "Traceback" not in outcome.err
