"""Errors about what is not there name the nearest that is."""

import pytest

from bench.errors import not_there


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("in/cameras.jsn", "in/cameras.jsn: expected a file, got no 'cameras.jsn' in "),
        ("in/CAMERA.json", "/in; nearest: cameras.json"),
        ("im/cameras.json", "nearest: in"),
        ("many/0", "/many; nearest: a1, a2, a3, a4, a5 and 2 more"),
        ("in", "in: expected a file, got a folder"),
        ("in/broken", "got a link to elsewhere, which is not there"),
    ],
)
def test_the_first_part_that_is_missing_and_the_nearest_name_are_said(path, said, tmp_path):
    for file in ("in/cameras.json", *(f"many/a{number}" for number in range(1, 8))):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    (tmp_path / "in/broken").symlink_to("elsewhere")
    assert said in str(not_there(tmp_path / path))
