"""Splits by every nth picture and by lists."""

import json
from pathlib import Path

import pytest
import torch

from bench.errors import SteerbenchError
from bench.scenes.images import View
from bench.scenes.splits import divide, read_lists
from bench.types import Camera

NAMES = [f"images/{k}.png" for k in range(6)]
VIEWS = [View(n, Path(n), Camera(torch.eye(4)[:3], 1, 1, 1, 1, 2, 2)) for n in NAMES]
LISTED = [*zip(NAMES, VIEWS, strict=True)][::-1]
RECORD = {"train_filenames": NAMES[:3], "val_filenames": ["./images/3.png"]}
RECORD |= {"test_filenames": ["/home/me/images/4.png", "5"]}


def numbers(views: dict[str, list[View]]) -> dict[str, str]:
    return {split: "".join(view.path.stem for view in part) for split, part in views.items()}


def test_a_missing_picture_does_not_move_the_others(log):
    listed = [(name, None if name == NAMES[1] else view) for name, view in LISTED]
    assert numbers(divide(listed, 2, None, Path(), log)) == {"train": "35", "test": "024"}


@pytest.mark.parametrize(
    ("change", "splits", "said"),
    [
        ({}, {"train": "012", "val": "3", "test": "45"}, "3 train, 1 val, 2 test"),
        ({"test_filenames": []}, {"train": "012", "test": "3"}, "in no list, left out: 2"),
        ({"train_filenames": None}, {"train": "012", "val": "3", "test": "45"}, "3 train"),
        ({"val_filenames": ["9.png", "0"]}, {"val": "0"}, "left out: 1; no pictures: 9"),
        ({"test_filenames": ["0", "5"]}, {"test": "05"}, "1 of them in train and test"),
    ],
)
def test_lists_are_obeyed_and_counted(change, splits, said, log):
    lists = read_lists(Path(), None, {**RECORD, **change}, Path("transforms.json"))
    assert numbers(divide(LISTED, 2, lists, Path(), log)).items() >= splits.items()
    (message,) = log.messages
    assert said in message


@pytest.mark.parametrize(
    ("file", "text", "test"),
    [
        ("test.txt", "# of the paper\n1.png\nimages/4\n\n", "14"),
        ("train_list.txt", "\n".join(NAMES[:4]), "45"),
        ("lists.json", json.dumps({"train": ["1", "2"], "test": ["3"]}), "3"),
        ("lists.json", json.dumps(RECORD), "45"),
    ],
)
def test_a_file_of_names_goes_before_the_lists_of_the_capture(tmp_path, log, file, text, test):
    (tmp_path / file).write_text(text)
    for root, split in ((tmp_path, file), (Path(), str(tmp_path / file))):
        lists = read_lists(root, split, {"test_filenames": ["0"]}, Path())
        assert numbers(divide(LISTED, 2, lists, Path(), log))["test"] == test


@pytest.mark.parametrize(
    ("split", "text", "message"),
    [
        ("none.txt", "", r"scene.split: expected a file of names, got no 'none.txt' in .*a.txt"),
        ("a.txt", "# none", r"a.txt: expected names of pictures, got none"),
        ("a.txt", "9.png", r"a.txt: test: .* such as images/5.png, got '9.png'"),
        ("a.json", '{"train": 3}', r"a.json: train: expected a list of names, got 3"),
        ("a.txt", "\n".join(NAMES), r"here: expected a picture to train on, got none of 0"),
    ],
)
def test_a_file_that_names_no_picture_is_refused(tmp_path, log, split, text, message):
    (tmp_path / ("a.txt" if split == "none.txt" else split)).write_text(text)
    with pytest.raises(SteerbenchError, match=message):
        divide(LISTED, 2, read_lists(tmp_path, split, {}, Path()), Path("here"), log)


def test_every_nth_can_be_asked_for():
    assert read_lists(Path(), "every", RECORD, Path()) is None
