"""A sweep on a cluster of Ray that exists already, of which an address is known."""

from __future__ import annotations

import os

import pytest

from tests.sweeps.conftest import PATH

pytest.importorskip("hydra_plugins.hydra_ray_launcher", reason="hydra-ray-launcher is an extra")


@pytest.mark.slow
def test_a_sweep_outlives_a_node_of_its_cluster(spawn, tmp_path, monkeypatch):
    """Two nodes on the loopback; the one whose job is in the middle of its training is killed."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", PATH)  # of the nodes
    outputs = tmp_path / "outputs"
    outputs.mkdir()
    for name in ("gate", "waiting"):
        os.mkfifo(outputs / name)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
        process = spawn(
            *("-m", "method._target_=stand_ins.Gated", "method.level=0.3,0.6"),
            *(f"outputs={outputs}", "hydra/launcher=ray"),
            f"hydra.launcher.ray.init.address={cluster.address}",
        )
        raylet = int((outputs / "waiting").read_text())
        (node,) = [node for node in nodes if node.all_processes["raylet"][0].process.pid == raylet]
        cluster.remove_node(node, allow_graceful=False)
        (outputs / "gate").unlink()
        out, err = process.communicate()
    finally:
        cluster.shutdown()
    assert process.returncode == 0, err
    for psnr in ("3.07", "7.96"):
        assert psnr in out
