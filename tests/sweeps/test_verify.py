"""`steerbench scenes verify`: exit status and what is printed of a damaged copy."""

from __future__ import annotations

from bench.scenes import integrity


def test_a_damaged_file_is_named_and_fails(steerbench, tmp_path, monkeypatch):
    scene = tmp_path / "mic"
    scene.mkdir()
    (scene / "good.png").write_bytes(b"good")
    (scene / "bad.png").write_bytes(b"bad")
    good = integrity.sha256(scene / "good.png")
    official = {"mic/good.png": good, "mic/bad.png": good, "mic/absent.png": good}
    monkeypatch.setattr(integrity, "official_hashes", lambda: official)
    outcome = steerbench("scenes", "verify", "mic")
    assert outcome.status == 1
    assert "wrong    mic/bad.png" in outcome.out
    assert "missing  mic/absent.png" in outcome.out
    assert "1 ok, 1 wrong, 1 missing, 0 extra" in outcome.out

    (scene / "bad.png").write_bytes(b"good")
    assert steerbench("scenes", "verify", "mic").status == 0


def test_a_folder_of_something_else_is_an_error(steerbench, tmp_path):
    outcome = steerbench("scenes", "verify", str(tmp_path))
    assert outcome.status == 2
    assert "expected NeRF-Synthetic" in outcome.err
