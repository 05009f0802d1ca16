"""Weights of others: where they are searched, downloads that lie, files that are damaged.

The publisher is a server on the loopback address.
"""

import hashlib
import io
from pathlib import Path

import pytest
import torch

from bench.types import Unavailable
from bench.weights import BACKBONES, load_features, locate
from tests.common import refusal

STATE = {"features.0.weight": torch.ones(2), "classifier.1.weight": torch.zeros(3)}


@pytest.fixture
def weights(publisher, monkeypatch) -> tuple[str, bytes]:
    """Name and bytes of a file whose name tells the beginning of its SHA-256."""
    buffer = io.BytesIO()
    torch.save(STATE, buffer)
    name = f"alexnet-owt-{hashlib.sha256(buffer.getvalue()).hexdigest()[:8]}.pth"
    monkeypatch.setitem(BACKBONES, "alex", (name, BACKBONES["alex"][1]))
    return name, buffer.getvalue()


def cache(tmp_path: Path) -> Path:
    return tmp_path / "torch/hub/checkpoints"


def test_weights_dir_precedes_environment_and_cache(publisher, monkeypatch, tmp_path, quiet_log):
    folders = [tmp_path / "given", tmp_path / "environment", cache(tmp_path)]
    for folder in folders:
        folder.mkdir(parents=True)
        torch.save(STATE, folder / "alexnet_features.pth")
    monkeypatch.setenv("STEERBENCH_WEIGHTS", str(folders[1]))
    for folder in folders:
        assert locate("alex", folders[0], quiet_log) == folder / "alexnet_features.pth"
        (folder / "alexnet_features.pth").unlink()


def test_weights_with_their_published_name_are_read_unless_damaged(tmp_path, weights, quiet_log):
    name, content = weights
    (tmp_path / name).write_bytes(content)
    path, features = load_features("alex", tmp_path, quiet_log)
    assert path == tmp_path / name
    assert torch.equal(features["features.0.weight"], STATE["features.0.weight"])
    (tmp_path / name).write_bytes(content[:-1] + b"?")
    with refusal(f"{name}: expected a SHA-256 that begins with", Unavailable):
        locate("alex", tmp_path, quiet_log)
    (tmp_path / "alexnet_features.pth").write_bytes(content[:100])
    with refusal(r"alexnet_features.pth: expected a torch state dict", Unavailable):
        load_features("alex", tmp_path, quiet_log)


def test_a_file_that_would_run_code_is_refused_and_runs_none(tmp_path, quiet_log):
    class Attack:
        def __reduce__(self):
            return Path.touch, (tmp_path / "attacked",)

    torch.save({"features.0.weight": Attack()}, tmp_path / "alexnet_features.pth")
    with pytest.raises(Unavailable):
        load_features("alex", tmp_path, quiet_log)
    assert not (tmp_path / "attacked").exists()


def test_a_failed_download_says_what_to_do_and_hinders_neither_others_nor_a_second_try(
    publisher, weights, quiet_log, tmp_path
):
    publisher.files[f"/{weights[0]}"] = weights[1]
    for _ in range(2):
        with pytest.raises(Unavailable) as caught:
            locate("vgg", None, quiet_log)
    assert locate("alex", None, quiet_log) == cache(tmp_path) / weights[0]
    assert publisher.asked == [*["/vgg16-397923af.pth"] * 2, f"/{weights[0]}"]
    for part in (f"{publisher.address}vgg16-397923af.pth", "404", "weights_dir=", "STEERBENCH_WE"):
        assert part in str(caught.value)


def test_downloaded_weights_are_kept_if_right(tmp_path, publisher, weights, quiet_log):
    name, content = weights
    publisher.files[f"/{name}"] = content[:-1]
    with refusal("SHA-256", Unavailable):
        locate("alex", None, quiet_log)
    assert not (cache(tmp_path) / name).exists()
    publisher.files[f"/{name}"] = content
    assert locate("alex", None, quiet_log) == cache(tmp_path) / name
    assert locate("alex", None, quiet_log).read_bytes() == content
    assert len(publisher.asked) == 2


def test_an_unknown_network_and_a_missing_folder_are_errors_not_gaps(tmp_path, quiet_log):
    with refusal("expected one of alex, vgg, got 'resnet'"):
        locate("resnet", None, quiet_log)
    with refusal(r"weights_dir: expected a folder, got .*nowhere"):
        locate("alex", tmp_path / "nowhere", quiet_log)
