"""Where LPIPS finds its backbones, and what it says when it does not."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pytest
import torch

from bench import lpips_weights
from bench.lpips_weights import BACKBONES, Backbone, load_features, locate
from bench.types import SteerbenchError, Unavailable

STATE = {"features.0.weight": torch.ones(2), "classifier.1.weight": torch.zeros(3)}


@pytest.fixture(autouse=True)
def publisher(monkeypatch, tmp_path, web):
    """An empty cache, no environment, and a publisher with no file."""
    monkeypatch.setattr(lpips_weights, "ADDRESS", web.address)
    monkeypatch.setattr(lpips_weights, "_unreachable", [])
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv("STEERBENCH_WEIGHTS", raising=False)
    return web


@pytest.fixture
def published(monkeypatch) -> tuple[str, bytes]:
    """Name and bytes of a file whose name tells the beginning of its SHA-256."""
    buffer = io.BytesIO()
    torch.save(STATE, buffer)
    name = f"alexnet-owt-{hashlib.sha256(buffer.getvalue()).hexdigest()[:8]}.pth"
    monkeypatch.setitem(BACKBONES, "alex", Backbone(name, BACKBONES["alex"].features))
    return name, buffer.getvalue()


def cache(tmp_path: Path) -> Path:
    return tmp_path / "torch" / "hub" / "checkpoints"


def test_weights_dir_comes_before_the_environment_and_that_before_the_cache(
    monkeypatch, tmp_path, quiet_log
):
    folders = [tmp_path / "given", tmp_path / "environment", cache(tmp_path)]
    for folder in folders:
        folder.mkdir(parents=True)
        torch.save(STATE, folder / "alexnet_features.pth")
    monkeypatch.setenv("STEERBENCH_WEIGHTS", str(folders[1]))
    for folder in folders:
        assert locate("alex", folders[0], quiet_log) == folder / "alexnet_features.pth"
        (folder / "alexnet_features.pth").unlink()


def test_a_file_with_its_published_name_is_read(tmp_path, published, quiet_log):
    name, content = published
    (tmp_path / name).write_bytes(content)
    path, features = load_features("alex", tmp_path, quiet_log)
    assert path == tmp_path / name
    assert torch.equal(features["features.0.weight"], STATE["features.0.weight"])


def test_a_damaged_file_with_its_published_name_is_refused(tmp_path, published, quiet_log):
    name, content = published
    (tmp_path / name).write_bytes(content[:-1] + b"?")
    with pytest.raises(Unavailable, match=f"{name}: expected a SHA-256 that begins with"):
        locate("alex", tmp_path, quiet_log)


def test_a_truncated_file_is_refused(tmp_path, published, quiet_log):
    (tmp_path / "alexnet_features.pth").write_bytes(published[1][:100])
    with pytest.raises(Unavailable, match=r"alexnet_features.pth: expected a torch state dict"):
        load_features("alex", tmp_path, quiet_log)


def test_a_file_that_would_run_code_is_refused_and_runs_none(tmp_path, quiet_log):
    class Attack:
        def __reduce__(self):
            return Path.touch, (tmp_path / "attacked",)

    torch.save({"features.0.weight": Attack()}, tmp_path / "alexnet_features.pth")
    with pytest.raises(Unavailable):
        load_features("alex", tmp_path, quiet_log)
    assert not (tmp_path / "attacked").exists()


def test_without_a_download_the_message_says_what_to_fetch_and_where_to_put_it(quiet_log, web):
    with pytest.raises(Unavailable) as caught:
        locate("vgg", None, quiet_log)
    assert web.asked == [("/vgg16-397923af.pth", 0)]
    address = f"{web.address}vgg16-397923af.pth"
    for part in (address, "404", "weights_dir=", "STEERBENCH_WEIGHTS"):
        assert part in str(caught.value)


def test_a_download_that_failed_is_not_tried_again_in_the_same_process(quiet_log, web):
    for net in ("alex", "vgg", "vgg"):
        with pytest.raises(Unavailable):
            locate(net, None, quiet_log)
    assert len(web.asked) == 1


def test_a_download_lands_in_the_cache_and_is_found_there_next_time(
    tmp_path, published, quiet_log, web
):
    name, content = published
    web.files[f"/{name}"] = content
    assert locate("alex", None, quiet_log) == cache(tmp_path) / name
    assert locate("alex", None, quiet_log).read_bytes() == content
    assert len(web.asked) == 1


def test_another_content_is_refused_and_not_kept(tmp_path, published, quiet_log, web):
    name, content = published
    web.files[f"/{name}"] = content[:-1]
    with pytest.raises(Unavailable, match="SHA-256"):
        locate("alex", None, quiet_log)
    assert not (cache(tmp_path) / name).exists()


def test_an_unknown_network_and_a_missing_folder_are_errors_not_gaps(tmp_path, quiet_log):
    with pytest.raises(SteerbenchError, match="expected one of alex, vgg, squeeze, got 'resnet'"):
        locate("resnet", None, quiet_log)
    with pytest.raises(SteerbenchError, match=r"weights_dir: expected a folder, got .*nowhere"):
        locate("alex", tmp_path / "nowhere", quiet_log)
