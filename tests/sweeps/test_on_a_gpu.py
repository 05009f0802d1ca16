"""The commands that take a device, with the paper's method on a pretended GPU, from the command
line to the page. `view` serves in threads, for which the pretence does not hold."""

import pytest

pytestmark = pytest.mark.slow

SMALLEST = [
    *("method=steernerf", "device=cuda", "method.backend=reference", "engine=torch"),
    *("scene=totem", "scene.width=16", "scene.train=2", "scene.test=4", "trajectory=test"),
    *("budget=tiny", "budget.frames=0", "budget.steps=2", "budget.samples=64"),
    *("budget.renderer_steps=2", "method.joint.distilled_views=1"),
    *("method.grid.levels=2", "method.grid.log2_table=10"),
    *("protocol.name=quick", "protocol.lpips=[]", "protocol.warmup=0"),
]
ROUNDS = "protocol.rounds=2"


@pytest.mark.parametrize(
    "command",
    [
        ["run", "report=page"],
        ["run", "protocol.stages=false"],
        ["render", "trajectory=orbit"],
        ["breakdown", ROUNDS, "protocol.waits=true"],
        ["parity", ROUNDS],
        ["skips", ROUNDS],
        ["accuracy", ROUNDS, "--only", "stop"],
        ["scaling", ROUNDS, "--only", "L"],
        ["table", "table2"],
        ["kernels", "--filter", "adam"],
    ],
    ids=" ".join,
)
def test_it_ends_well(command, steerbench, gpu):
    name, *options = command
    steerbench(name, *options, *(SMALLEST if name != "kernels" else ())).ok()
    assert gpu.waited


def test_pictures_are_scored_there(steerbench, gpu, lpips_weights):
    words = ("scene.width=32", "protocol.lpips=[alex]", f"weights_dir={lpips_weights}")
    outcome = steerbench("run", *SMALLEST, *words).ok()
    assert "LPIPS alex" in outcome.out
