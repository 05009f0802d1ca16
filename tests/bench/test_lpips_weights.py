"""Where LPIPS finds its backbones, and what it says when it does not. No test uses a network."""

from __future__ import annotations

import hashlib
import io
import urllib.error
import urllib.request
from pathlib import Path

import pytest
import torch

from bench import lpips_weights
from bench.lpips_weights import BACKBONES, Backbone, load_features, locate
from bench.types import SteerbenchError, Unavailable

STATE = {"features.0.weight": torch.ones(2), "classifier.1.weight": torch.zeros(3)}


@pytest.fixture(autouse=True)
def offline(monkeypatch, tmp_path):
    """An empty cache, no environment, a network that is down; lists the addresses asked for."""
    asked: list[str] = []

    def refuse(address: str, timeout: float):
        asked.append(address)
        raise urllib.error.URLError("no route to host")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)
    monkeypatch.setattr(lpips_weights, "_unreachable", [])
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv("STEERBENCH_WEIGHTS", raising=False)
    return asked


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


def test_without_a_network_the_message_says_what_to_fetch_and_where_to_put_it(
    tmp_path, quiet_log, offline
):
    with pytest.raises(Unavailable) as caught:
        locate("vgg", None, quiet_log)
    address = "https://download.pytorch.org/models/vgg16-397923af.pth"
    assert offline == [address]
    for part in (address, "no route to host", "weights_dir=", "STEERBENCH_WEIGHTS"):
        assert part in str(caught.value)
    assert not list(cache(tmp_path).iterdir())


def test_a_download_that_failed_is_not_tried_again_in_the_same_process(quiet_log, offline):
    for net in ("alex", "vgg", "vgg"):
        with pytest.raises(Unavailable):
            locate(net, None, quiet_log)
    assert len(offline) == 1


class Response(io.BytesIO):
    """What `urlopen` returns, as far as it is used."""

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self.headers = {"Content-Length": str(len(content))}


def test_a_download_lands_in_the_cache_and_is_found_there_next_time(
    monkeypatch, tmp_path, published, quiet_log
):
    name, content = published
    answers = [Response(content)]
    monkeypatch.setattr(urllib.request, "urlopen", lambda address, timeout: answers.pop())
    assert locate("alex", None, quiet_log) == cache(tmp_path) / name
    assert locate("alex", None, quiet_log).read_bytes() == content
    assert [path.name for path in cache(tmp_path).iterdir()] == [name]


def test_a_download_cut_short_leaves_nothing_behind(monkeypatch, tmp_path, published, quiet_log):
    short = published[1][:-1]
    monkeypatch.setattr(urllib.request, "urlopen", lambda address, timeout: Response(short))
    with pytest.raises(Unavailable, match="SHA-256"):
        locate("alex", None, quiet_log)
    assert not list(cache(tmp_path).iterdir())


def test_an_unknown_network_and_a_missing_folder_are_errors_not_gaps(tmp_path, quiet_log):
    with pytest.raises(SteerbenchError, match="expected one of alex, vgg, squeeze, got 'resnet'"):
        locate("resnet", None, quiet_log)
    with pytest.raises(SteerbenchError, match=r"weights_dir: expected a folder, got .*nowhere"):
        locate("alex", tmp_path / "nowhere", quiet_log)
