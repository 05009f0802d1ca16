"""A renderer in another process as a method: what it learns from, and what comes back."""

from dataclasses import replace
from textwrap import dedent

import pytest
import torch

from bench.cameras import move_camera
from bench.clock import StageClock
from bench.console import ConsoleLog
from bench.scenes import blender
from bench.scenes.assemble import hold_out
from bench.study import Variant
from bench.types import Budget, NullProbe, SteerbenchError
from methods.gaussians import ply
from tests.common import assert_near, read_json, refusal
from tests.methods.gaussians.test_ply import some

BUDGET = Budget("test", steps=7, samples=9)


STORES = """
    class Stores(Grey):
        knobs = {"shade": [0.5, 1.0]}
        memory, precision = 2, "fp64"

        def __init__(self, level=0.25, shade=1.0):
            self.wanted, self.shade = level, shade

        def fit(self, job):
            print("trained")
            self.level = self.wanted * self.shade
            (job.state / "level").write_text(str(self.wanted))

        def load(self, job):
            self.level = float((job.state / "level").read_text()) * self.shade
"""


def level(method, scene) -> float:
    return float(method.render(scene.splits["test"].cameras[0], NullProbe()).rgb.mean())


def test_its_times_are_those_of_the_frame_and_the_pipe_is_beside_them(
    worker, external, tiny_scene, quiet_log
):
    lines = """
    from steerbench_worker import count, stage

    class Staged(Grey):
        def render(self, camera):
            with stage("march"), stage("lookup"):
                count("rays", 3)
            count("rays", 4)
            return super().render(camera)
    """
    method = external(worker(lines, after="serve(Staged)\n"))
    method.fit(tiny_scene, BUDGET, quiet_log)
    clock = StageClock("cpu")
    with clock.frame():
        frame = method.render(tiny_scene.splits["test"].cameras[0], clock)
    (record,) = clock.frames
    assert record.stages_ns.keys() == {"march", "march/lookup", "other"}
    assert record.done == {"rays": 7}
    assert record.wall_ns > record.total_ns > 0
    assert record.peak_bytes > 1e6
    assert torch.equal(frame.rgb, torch.full((32, 40, 3), 0.5))
    assert (frame.depth == torch.inf).all()
    assert (frame.alpha == 1).all()


def test_cameras_and_depths_are_in_the_units_of_the_data_set(
    worker, external, moved_scene, quiet_log
):
    lines = """
    class Looks(Grey):
        def render(self, camera):
            size = camera.height, camera.width
            lens = camera.fx, camera.fy, camera.cx, camera.cy
            picture, alpha = np.full((*size, 3), 51, np.uint8), np.zeros(size)
            alpha[0, :16] = *camera.c2w.flatten(), *lens
            return {"rgb": picture, "depth": np.full(size, 6.0), "alpha": alpha}
    """
    method = external(worker(lines, after="serve(Looks)\n"))
    method.fit(moved_scene, BUDGET, quiet_log)
    camera = moved_scene.splits["test"].cameras[1]
    frame = method.render(camera, NullProbe())
    torch.testing.assert_close(frame.rgb, torch.full((32, 40, 3), 0.2))
    assert (frame.depth == 2).all()
    pose = move_camera(camera, 3.0, moved_scene.origin).c2w.flatten()
    told = torch.cat((pose, torch.tensor([60.0, 60.0, 20.0, 16.0])))
    assert torch.equal(frame.alpha[0, :16], told)
    assert not frame.alpha[1:].any()


def test_it_sees_only_training_pictures(worker, external, moved_scene, quiet_log, tmp_path):
    lines = f"""
    import json, shutil

    class Keeps(Grey):
        def fit(self, job):
            super().fit(job)
            shutil.copytree(job.scene, {str(tmp_path / "seen")!r})
            assert [path.is_file() for path, _ in job.pictures] == [True] * len(job.pictures)
            told = [job.steps, job.samples, job.seed, job.bounds, len(job.pictures)]
            print(json.dumps(told))
    """
    train = moved_scene.splits["train"]
    several = replace(train, cameras=[*train.cameras] * 2, images=[*train.images] * 2)
    several = replace(several, names=[str(i) for i in range(8)])
    scene = hold_out(replace(moved_scene, splits={"train": several}), "validation", 8)
    method = external(worker(lines, after="serve(Keeps)\n"))
    method.fit(scene, BUDGET, quiet_log)
    assert len(list((tmp_path / "seen").rglob("*.png"))) == 7
    seen = blender.load(tmp_path / "seen", bounds="full", log=quiet_log)
    for split in ("train", "val", "test"):
        assert len(seen.splits[split]) == 7
        for one, other in zip(seen.splits[split].images, scene.splits["train"].images, strict=True):
            assert torch.equal(one, other)
    (kept,) = tmp_path.glob("outputs/stages/*/output.txt")
    bounds = [[-1.5] * 3, [1.5] * 3]
    assert read_json(kept) == [7, 9, 3, bounds, 7]


def test_what_it_stores_is_loaded_and_a_knob_needs_no_training(
    worker, external, tiny_scene, quiet_log, tmp_path
):
    path = worker(STORES, after="serve(Stores)\n")
    seconds = []
    for options, shown in (({}, 0.25), ({"shade": 0.5}, 0.125), ({"level": 0.75}, 0.75)):
        method = external(path, options=options)
        method.fit(tiny_scene, BUDGET, quiet_log)
        seconds.append(method.train_s)
        assert level(method, tiny_scene) == shown
    assert seconds[0] == seconds[1] > 0
    assert len(list(tmp_path.glob("outputs/stages/external-*"))) == 2
    assert method.sizes() == {"model": 4}
    assert (method.name, method.memory) == ("Stores", 2)
    shown = {"device": "cpu", "backend": "external", "field_precision": "fp64"}
    shown |= {"engine": "none", "precision": "none"}
    assert shown.items() < method.settings().items()
    expected = Variant("shade 0.5", ("++method.options.shade=0.5",))
    assert method.study.knobs["shade"][0] == expected


def test_what_it_was_trained_with_makes_another_training(
    worker, external, tiny_scene, quiet_log, tmp_path
):
    path = worker(STORES, after="serve(Stores)\n")
    more = tmp_path / "more"
    more.mkdir()

    def stages(**settings):
        external(path, **settings).fit(tiny_scene, BUDGET, quiet_log)
        return len(list(tmp_path.glob("outputs/stages/external-*")))

    assert stages() == stages() == 1
    assert stages(seed=4) == 2
    worker(STORES, after="CHANGED = 1\nserve(Stores)\n")
    assert stages() == 3
    worker(STORES, after="CHANGED = 1  # by a comment\nserve(Stores)\n")
    assert stages() == 3
    (path.parent / "lib.py").write_text("")
    worker(STORES, after="import lib\nserve(Stores)\n")
    assert stages() == 4
    (path.parent / "lib.py").write_text("SHADE = 1")
    assert stages() == 5
    (more / "data").write_text("one")
    (more / ".hidden").write_text("")
    assert stages(files=[str(more)]) == 6
    (more / ".hidden").write_text("changed")
    assert stages(files=[str(more)]) == 6
    (more / "data").write_text("two")
    assert stages(files=[str(more)]) == 7
    assert stages(lock="echo torch==1") == 8
    assert stages(lock="echo torch==2") == 9
    path = f"{path} --width 9"
    assert stages() == 10


def test_a_new_process_renders_without_what_a_training_left(
    worker, external, tiny_scene, quiet_log
):
    lines = """
        import os

        class Renews(Grey):
            def fit(self, job):
                (job.state / "process").write_text(str(os.getpid()))

            def load(self, job):
                self.level = float((job.state / "process").read_text() != str(os.getpid()))
    """
    method = external(worker(lines, after="serve(Renews)\n"))
    method.fit(tiny_scene, BUDGET, quiet_log)
    assert level(method, tiny_scene) == 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"files": ["nowhere"]}, "method.files: expected files and folders, got nowhere, which is"),
        ({"lock": "ls /nowhere"}, "method.lock: ls /nowhere: .*No such file"),
        ({"lock": "'"}, "method.lock: expected a program and its arguments"),
        ({"options": {"colour": 1}}, "worker Stores: failed at 'settings': TypeError: .*'colour'"),
    ],
)
def test_a_setting_that_is_wrong_is_named(wrong, said, worker, external, tiny_scene, quiet_log):
    method = external(worker(STORES, after="serve(Stores)\n"), **wrong)
    with refusal(said):
        method.fit(tiny_scene, BUDGET, quiet_log)


def test_a_training_that_failed_leaves_nothing_to_load(
    worker, external, tiny_scene, quiet_log, tmp_path
):
    fails = """
        def fit(self, job):
            (job.state / "half").write_text("of it")
            raise ValueError("too bad")
    """
    with refusal("ValueError: too bad"):
        external(worker(STORES + fails, after="serve(Stores)\n")).fit(tiny_scene, BUDGET, quiet_log)
    assert [path.name for path in tmp_path.glob("outputs/stages/external-*/*")] == ["lock"]


def test_a_ply_file_is_rendered_without_its_data_set(external, moved_scene, tmp_path, quiet_log):
    path = tmp_path / "some.ply"
    gaussians = some()
    ply.write(gaussians, moved_scene, path)
    method = external("ply", options={"file": str(path)})
    method.fit(moved_scene, BUDGET, quiet_log)
    assert not method.trains
    camera = moved_scene.splits["test"].cameras[2]
    frame = method.render(camera, NullProbe())
    with torch.no_grad():
        pixels = gaussians.render(camera, 1e-4, NullProbe())
    expected = pixels.over(torch.ones(3)).values.view(32, 40, 3)
    # Where the file's units and ours round differently, a Gaussian's edge may fall the other way.
    assert (frame.rgb - expected).abs().quantile(0.99) < 1e-4
    assert method.sizes() == {"gaussians": 50 * 59 * 4}
    assert path in method.reads
    assert not (tmp_path / "outputs").exists()  # nothing was trained, nothing was written


def test_what_is_said_of_a_ply_file_is_shown_and_nothing_beside_it(
    external, moved_scene, tmp_path, capfd
):
    path, log = tmp_path / "some.ply", ConsoleLog(tmp_path)
    ply.write(some(), moved_scene, path)
    path.write_bytes(path.read_bytes().replace(b"1.0\n", b"1.0\ncomment antialiased 1\n", 1))
    external("ply", options={"file": str(path)}).fit(moved_scene, BUDGET, log)
    assert f"ply: {path}: trained with antialiasing" in capfd.readouterr().err
    path.write_text("no Gaussians\n")
    with pytest.raises(SteerbenchError) as error:
        external("ply", options={"file": str(path)}).fit(moved_scene, BUDGET, log)
    assert str(error.value).startswith(f"ply: {path}: expected a PLY file of 3D Gaussians, could")
    assert "last words" not in str(error.value)


STUDIO = """
    from types import SimpleNamespace

    import torch

    class Cameras:
        def __init__(self, c2w, *lens):
            self.c2w, self.lens = c2w, lens

        def to(self, device):
            return self

    class Model(torch.nn.Linear):
        def __init__(self, *sizes):
            super().__init__(*sizes)
            self.lpips = torch.nn.Linear(9, 9)  # no part of a picture
            self.register_buffer("grid", torch.zeros(5))

        def get_outputs_for_camera(self, camera):
            picture = torch.zeros(32, 40, 3)
            picture[0, :18, 0] = torch.cat((camera.c2w.flatten(), torch.tensor(camera.lens)))
            return {"picture": picture}

    def eval_setup(config, test_mode):
        turn = torch.tensor([[0.0, 1.0, 0.0, 5.0], [-1.0, 0.0, 0.0, 6.0], [0.0, 0.0, 1.0, 7.0]])
        data = SimpleNamespace(dataparser_transform=turn, dataparser_scale=0.5)
        manager, model = SimpleNamespace(train_dataparser_outputs=data), Model(2, 3)
        pipeline = SimpleNamespace(datamanager=manager, model=model, device="cpu")
        return SimpleNamespace(method_name="nerfacto"), pipeline, config.with_name("a.ckpt"), 9
"""


def test_a_nerfstudio_model_gets_the_camera_in_its_own_coordinates(
    external, moved_scene, quiet_log, tmp_path, monkeypatch
):
    """With a stand-in for the package, whose picture holds the camera."""
    for name, lines in (
        ("__init__", ""),
        ("cameras/__init__", ""),
        ("cameras/cameras", STUDIO),
        ("utils/__init__", ""),
        ("utils/eval_utils", "from nerfstudio.cameras.cameras import eval_setup"),
    ):
        path = tmp_path / f"nerfstudio/{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(dedent(lines))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    options = {"config": str(tmp_path / "config.yml"), "output": "picture"}
    method = external("nerfstudio", options=options)
    method.fit(moved_scene, BUDGET, quiet_log)
    assert (method.name, method.sizes()) == ("nerfacto", {"model": 4 * (2 * 3 + 3 + 5)})
    camera = moved_scene.splits["test"].cameras[1]
    shown = method.render(camera, NullProbe()).rgb[0, :18, 0]
    x, y, z = move_camera(camera, 3.0, moved_scene.origin).c2w * torch.tensor([1, -1, -1, 1])
    # A quarter turn, a shift by (5, 6, 7), and half of it.
    wanted = torch.stack((y, -x, z))
    wanted[:, 3] = (wanted[:, 3] + torch.tensor([5.0, 6.0, 7.0])) / 2
    lens = torch.tensor([60.0, 60.0, 20.0, 16.0, 40.0, 32.0])
    assert_near(shown, torch.cat((wanted.flatten(), lens)), atol=1e-6)
    method = external("nerfstudio", options={"config": "config.yml"})
    method.fit(moved_scene, BUDGET, quiet_log)
    with refusal("output: expected one of picture, got rgb"):
        method.render(camera, NullProbe())
