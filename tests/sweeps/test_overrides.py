"""Wrong settings: one line that names what was typed, the nearest names, and what exists."""

import shlex

import pytest

from sweeps.overrides import as_typed, composed, setting
from tests.common import refusal

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
          for word in ("demo", "a=b=c", "seed=[")),
        ("method=steernerf field=nerf", "field: each method brings its own"),
        ("scene=blender", "scene.path is not set: give scene.path=...\n"),
        ("method.level=7", "method.level: expected 0 to 1, got 7.0\n"),
        ("split=holdout", "split: expected test or validation, got 'holdout'\n"),
        ("seed=one", "seed: expected int, got 'one'\n"),
        ("seed=-1", "seed: expected 0 or more, below 2^63, got -1\n"),
        (f"seed={2**63}", "seed: expected 0 or more, below 2^63"),
        ("precision=fp8", "precision: expected fp32"),
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


ODD = ["a=b", "a,b", "szene-ä-日本", "a  b ", "a(1)", "[1]", "a{1}", "50%", "it's", "$HOME", "a#b"]
ODD += ["a:b", "a${b}", "'", '"a"', "2024", "null", "a\\", "choice(a,b)", "~a"]


@pytest.mark.parametrize("name", ODD)
def test_a_folder_is_read_as_it_is_typed_whatever_its_name(name, tmp_path):
    (tmp_path / name).mkdir()
    folder = str(tmp_path / name)
    for words in ([f"scene.path={folder}"], [setting("scene.path", folder)]):
        config = composed(["scene=blender", *as_typed(words)])
        assert config.scene.path == folder
    if name not in ("null", "a${b}", "choice(a,b)", "a,b", "'", '"a"'):  # nor need it be there
        assert composed([f"outputs={name}"]).outputs == name


def test_commas_separate_values_unless_they_are_in_a_name(tmp_path):
    assert as_typed(["scene.path=a,b=c"]) == ["scene.path=a,'b=c'"]
    (tmp_path / "a,b").touch()
    assert as_typed([f"+method.file={tmp_path}/a,b"]) == [f"+method.file='{tmp_path}/a,b'"]


@pytest.mark.parametrize("word", ["protocol.name=a=b", "protocol.name=ä", "protocol.name=a,`b`"])
def test_the_hint_works_when_it_is_copied_into_a_shell(word):
    with refusal("in quotes inside quotes") as refused:
        composed([word])
    (hint, *_) = shlex.split(str(refused.value).partition("inside quotes, ")[2])
    assert composed([hint]).protocol.name == word.partition("=")[2]


@pytest.mark.parametrize("content", [b"a: b: c", b"- 1", b"", b"\xff\xfe", b"_target_: 5", b"7"])
def test_a_choice_that_is_no_yaml_of_settings_is_named_in_one_line(content, steerbench, tmp_path):
    (tmp_path / "further/method").mkdir(parents=True)
    (tmp_path / "further/method/mine.yaml").write_bytes(content)
    refused = steerbench("run", f"--config-dir={tmp_path / 'further'}", "method=mine").refused()
    assert "mine.yaml: expected" in refused or "method: its YAML file: expected" in refused
    assert refused.count("\n") == 1


def test_a_choice_of_ones_own_that_has_a_name_of_ours_is_said_not_to_be_used(tmp_path, capsys):
    own = tmp_path / "budget" / "tiny.yaml"
    own.parent.mkdir()
    own.write_text("steps: 7\n")
    for _ in range(2):
        composed([f"--config-dir={tmp_path}", "budget=tiny"])
    assert capsys.readouterr().err == f"{own}: not used: a choice of ours has this name\n"
