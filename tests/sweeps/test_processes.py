"""Pools of processes, the files of locks; sweeps run through Hydra's launchers alike."""

import os
import select
import tempfile
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sweeps.processes import LOCKS, lock_file, processes
from tests.sweeps.conftest import PATH


@pytest.fixture(autouse=True)
def locks(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(LOCKS, str(tmp_path))


def test_who_is_told_to_end_does_not_wait_for_its_processes():
    with suppress(SystemExit), processes(1) as pool:
        waiting = pool.submit(select.select, [], [], [], 60.0)  # longer than a test may take
        while not waiting.running():
            os.sched_yield()
        raise SystemExit
    assert isinstance(waiting.exception(), BrokenProcessPool)


def test_gpus_are_told_apart_by_their_uuid(monkeypatch):
    names = {"cuda:0": "GPU-a", "cuda:1": "GPU-b"}
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid=names[device])
    )
    first, second = map(lock_file, names)
    assert first != second
    names["cuda:0"] = "GPU-b"  # as another job counts them
    assert lock_file("cuda:0") == second


def test_locks_lie_where_every_job_and_user_of_the_machine_sees_them(tmp_path, monkeypatch):
    monkeypatch.delenv(LOCKS)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "of this job"))
    assert lock_file("cpu").parent == Path("/var/tmp")


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_a_launcher_runs_every_job_and_names_those_that_fail(spawn, launcher):
    plugin = f"hydra_{launcher.partition('_')[0]}_launcher"
    pytest.importorskip(f"hydra_plugins.{plugin}", reason=f"{plugin} is an extra")
    process = spawn("-m", "method.level=0.3,0.6,7", f"hydra/launcher={launcher}")
    out, err = process.communicate()
    assert process.returncode == 2, err
    for cell in ("3.07", "7.96", "level=7): failed: method.level: expected 0 to 1"):
        assert cell in out


@pytest.mark.slow
def test_a_sweep_outlives_a_node_of_its_cluster(spawn, tmp_path, monkeypatch):
    """Two nodes on the loopback; the one whose job is in the middle of its training is killed."""
    pytest.importorskip("hydra_plugins.hydra_ray_launcher", reason="it is an extra")
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
