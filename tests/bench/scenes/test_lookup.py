"""Files by the names that other tools, systems and machines give them."""

from pathlib import Path

import pytest

from bench.errors import SteerbenchError
from bench.scenes.lookup import find_all, report


@pytest.fixture
def root(tmp_path) -> Path:
    """A folder `scan` with pictures, beside another one."""
    pictures = ("a.png", "b.JPG", "e\u0301.png", "other.png")
    for name in (*(f"scan/rgb/{picture}" for picture in pictures), "other/c.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "scan/link").symlink_to(tmp_path / "other")
    return tmp_path / "scan"


@pytest.mark.parametrize(
    ("name", "found", "told"),
    [
        ("rgb/a.png", "rgb/a.png", False),
        ("./rgb/../rgb/a.png", "rgb/a.png", False),
        ("rgb/a", "rgb/a.png", False),
        ("rgb/b", "rgb/b.JPG", False),
        ("rgb\\a.png", "rgb/a.png", False),
        ("rgb/\u00e9.png", "rgb/e\u0301.png", True),
        ("RGB/A.png", "rgb/a.png", True),
        ("rgb/b.png", "rgb/b.JPG", True),
        ("link/c.png", "link/c.png", False),
        ("../other/c.png", "../other/c.png", False),
        ("{root}/rgb/a.png", "rgb/a.png", False),
        ("rgb", None, False),
        ("rgb/a.txt", None, False),
        ("/home/other/scan/rgb/a.png", None, False),
        ("x" * 5000, None, False),
        ("rgb/\0.png", None, False),
    ],
)
def test_a_file_is_found_and_told_if_its_name_or_place_differs(root, log, name, found, told):
    names = [name.format(root=root), "rgb/other.png"]
    files = find_all(root, names)
    assert files[0] is None if found is None else files[0].samefile(root / found)
    report(root, names, files, "here", log, False)
    assert len(log.messages) == (told or found is None)


def test_no_picture_is_that_of_two_names(root):
    assert find_all(root, ["rgb/A.jpg", "rgb/a.png"]) == [None, root / "rgb/a.png"]
    (root / "rgb/c.png").touch()
    assert find_all(root, ["rgb/c.bmp", "rgb/c.jpg"]) == [root / "rgb/c.png", None]
    assert find_all(root, ["rgb/c", "rgb/c"]) == [root / "rgb/c.png"] * 2
    (root / "rgb/c.jpg").touch()
    found = [root / "rgb/c.jpg", root / "rgb/c.png"]
    assert find_all(root, ["rgb\\c.jpg", "rgb/c"]) == found


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("C:\\data\\rgb\\a.png", "rgb/a.png"),
        ("/home/me/rgb/a.png", "rgb/a.png"),
        ("rgb/aa.png", "rgb/a.png"),
        ("rbg/0.png", "rgb"),
    ],
)
def test_what_is_missing_is_named_with_what_is_nearest(root, log, name, nearest):
    with pytest.raises(SteerbenchError) as error:
        report(root, [name, "rgb/0"], [None, root / "rgb/a.png"], "here", log, True)
    expected = f"here: expected pictures, got 1 of 2 not there: no '{name}' in {root}; nearest: "
    assert str(error.value) == f"{expected}{root / nearest}"
