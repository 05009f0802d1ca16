"""Splits by every nth picture and by lists."""

from pathlib import Path

import pytest
import torch

from bench.scenes.images import View
from bench.scenes.splits import divide, read_lists
from bench.types import Camera
from tests.common import refusal

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
        ({"test_filenames": ["0", "5"]}, {"test": "05"}, "3 train, 1 val, 2 test"),
    ],
)
def test_lists_are_obeyed_and_counted(change, splits, said, log):
    lists = read_lists(Path(), None, {**RECORD, **change}, Path("transforms.json"))
    assert numbers(divide(LISTED, 2, lists, Path(), log)).items() >= splits.items()
    (message,) = log.messages
    assert said in message


@pytest.mark.parametrize("text", ["# of the paper\n1.png\n4\n\n", "/a/images/1.jpg\n./4"])
def test_a_file_of_names_goes_before_the_lists_of_the_capture(tmp_path, log, text):
    for name, split, others in (("mine.txt", "test", "train"), ("Train_1.txt", "train", "test")):
        (tmp_path / name).write_text(text)
        for root, given in ((tmp_path, name), (Path(), str(tmp_path / name))):
            lists = read_lists(root, given, {"test_filenames": ["0"]}, Path())
            found = numbers(divide(LISTED, 2, lists, Path(), log))
            assert found == {split: "14", others: "0235"}


@pytest.mark.parametrize(
    ("split", "text", "message"),
    [
        ("none.txt", "", r"scene.split: expected a file of names, got no 'none.txt' in .*a.txt"),
        ("a.txt", "# none", r"a.txt: expected names of pictures, got none"),
        ("a.txt", "9.png", r"a.txt: test: .* such as images/0.png, got '9.png'"),
        (
            "a.txt",
            "\n".join(NAMES),
            r"here: expected a picture to train on, got no file for train, which has 0 of",
        ),
        (None, "", r"here: train_filenames: expected a list of names, got 3"),
    ],
)
def test_a_file_that_names_no_picture_is_refused(tmp_path, log, split, text, message):
    (tmp_path / "a.txt").write_text(text)
    record, here = {"train_filenames": 3}, Path("here")
    with refusal(message):
        divide(LISTED, 2, read_lists(tmp_path, split, record, here), here, log)
