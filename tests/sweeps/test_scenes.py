"""`steerbench scenes`: exit status and what is printed; the web server is a stand-in."""

from tests.bench.test_datasets import publish


def test_a_damaged_file_is_named_and_fails(steerbench, tmp_path, monkeypatch):
    publish(monkeypatch, {"mic/good.png": b"good", "mic/bad.png": b"good", "mic/absent.png": b""})
    scene = tmp_path / "mic"
    scene.mkdir()
    (scene / "good.png").write_bytes(b"good")
    (scene / "bad.png").write_bytes(b"bad")
    outcome = steerbench("scenes", "verify", "mic")
    assert outcome.status == 1
    assert "wrong    mic/bad.png" in outcome.out
    assert "missing  mic/absent.png" in outcome.out
    assert "1 ok, 1 wrong, 1 missing, 0 extra" in outcome.out

    (scene / "bad.png").write_bytes(b"good")
    assert steerbench("scenes", "verify", "mic").status == 0


def test_get_says_how_to_run_on_what_it_got(steerbench, monkeypatch, web, tmp_path):
    publish(monkeypatch, {"mic/a.png": b"a", "lego/a.png": b"b"}, folder=web.address)
    web.files = {"/mic/a.png": b"a", "/lego/a.png": b"b"}
    outcome = steerbench("scenes", "get", "release", "--to", "mine").ok()
    assert "scene=blender scene.path=mine/release/lego\n" in outcome.out
    assert "licence: free" in outcome.out
    assert (tmp_path / "mine/release/mic/a.png").read_bytes() == b"a"
    assert steerbench("scenes", "verify", "mine/release").status == 0


def test_export_says_how_to_train_on_it_and_how_to_score_what_others_render(steerbench):
    sizes = "scene.width=16", "scene.train=2", "scene.test=3"
    outcome = steerbench("scenes", "export", "totem", "--to", "out", "--path", "orbit", *sizes).ok()
    assert "scene=blender scene.path=out\n" in outcome.out
    told = outcome.out.split("its path: steerbench ")[1].split()
    words = [word.replace("PICTURES", "out/test") for word in told]
    scored = steerbench(*words, "protocol.lpips=[]", "protocol.name=quick").ok()
    assert "3 pictures" in scored.err
    assert steerbench("scenes", "export", "totem", "--to", "out", *sizes).status == 2
