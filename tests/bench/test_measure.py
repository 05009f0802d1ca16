"""A measurement reports what really happened, and nothing it could not find out."""

import itertools
import math
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import bench.measure
from bench.clock import FrameRecord
from bench.measure import MethodFailed, Task, _Take, measure, train
from bench.metrics import psnr, quantise
from bench.protocol import EvaluationProtocol
from bench.results import COLUMNS
from bench.rows import path_interval
from bench.trajectories import Trajectory, from_split
from bench.types import Budget, Scene, SteerbenchError, composite
from tests.conftest import QUICK, STEERBENCH_1, OffsetMethod

PROTOCOL = replace(QUICK, warmup=2)
BUDGET = Budget("tiny", steps=1, samples=1)


@pytest.fixture
def run(tiny_scene, quiet_log):
    """`train` and `measure` on the tiny scene's test split, with anything replaced that a test is
    about: what was measured of one method, or a list of several."""

    def measured(*methods, **changes):
        task = Task(tiny_scene, from_split(tiny_scene), PROTOCOL, BUDGET, seed=5)
        task = replace(task, **changes)
        guard = train(methods, task, quiet_log)
        found = measure(methods, task, quiet_log, guard)
        return found if len(methods) > 1 else found[0]

    return measured


def row(rows, metric: str) -> dict:
    (found,) = rows[rows["metric"] == metric].to_dict("records")
    return found


def value(rows, metric: str) -> float:
    return row(rows, metric)["value"]


def test_the_rows_have_every_column_but_what_the_store_adds(run, offset_method, device):
    rows = run(offset_method).rows
    assert set(rows.columns) == set(COLUMNS) - {"run", "commit"}
    seen = "test, seen by the method"
    what = {"method": "offset", "scene": "tiny", "split": seen, "trajectory": "test"}
    how = {"resolution": "40x32", "protocol": "quick", "budget": "tiny", "seed": 5}
    by = {"device": device, "backend": "reference", "field_precision": "fp32"}
    by |= {"engine": "none", "precision": "none"}
    for column, expected in (what | how | by).items():
        assert set(rows[column]) == {expected}
    assert not rows["metric"].duplicated().any()
    counted = {"work.pixels": 40 * 32 / 4, "work.pixels.dense": 40 * 32, "train_s": 12.5}
    sizes = {"size_bytes.offset": 4, "size_bytes.table": 100, "size_bytes.total": 104}
    assert {metric: value(rows, metric) for metric in counted | sizes} == counted | sizes
    assert value(rows, "peak_bytes") > 0


def test_every_picture_is_decoded_before_the_training(run, offset_method, tiny_scene):
    class Decoded(list):
        def __iter__(self):
            offset_method.calls.append("decode")
            return super().__iter__()

    lazy = {name: replace(of, images=Decoded(of.images)) for name, of in tiny_scene.splits.items()}
    run(offset_method, scene=replace(tiny_scene, splits=lazy))
    assert offset_method.calls[:3] == ["decode", "decode", "fit"]


def test_quality_is_the_mean_over_frames_of_the_protocols_scores(run, offset_method, tiny_scene):
    measured = run(offset_method)
    scores = []
    for image in tiny_scene.splits["test"].images:
        truth = composite(image, tiny_scene.background)
        scores.append(psnr(quantise(truth + 8 / 255), truth))
    assert measured.frames["psnr"].tolist() == pytest.approx(scores, rel=1e-9)
    assert value(measured.rows, "psnr") == pytest.approx(np.mean(scores), rel=1e-9)
    assert row(measured.rows, "psnr")["unit"] == "dB"
    assert measured.frames["name"].tolist() == tiny_scene.splits["test"].names
    found = row(measured.rows, "psnr")  # its interval, of the frames in the order of their path
    assert found["hi"] - found["value"] == pytest.approx(path_interval(np.array(scores)))


def test_the_stages_of_a_frame_add_up_and_the_rate_has_the_interval_of_the_time(run, offset_method):
    measured = run(offset_method)
    stages = [name for name in measured.frames if name.startswith("stage_ms.")]
    assert stages == ["stage_ms.look-up", "stage_ms.look-up/add", "stage_ms.other"]
    sums = measured.frames[stages].sum(axis=1)
    np.testing.assert_allclose(sums, measured.frames["frame_ms"], rtol=1e-12)
    whole = run(offset_method, protocol=replace(PROTOCOL, stages=False)).frames
    assert [name for name in whole if name.startswith("stage_ms.")] == ["stage_ms.other"]
    # The interval of frames a second follows from that of the mean time.
    ms, fps = row(measured.rows, "frame_ms"), row(measured.rows, "fps")
    assert fps["lo"] == pytest.approx(1000 / ms["hi"])
    assert math.isnan(fps["hi"]) or fps["hi"] == pytest.approx(1000 / ms["lo"])


def test_warm_up_frames_come_first_and_a_method_forgets_them(run, offset_method):
    measured = run(offset_method)
    sequence = [f"r_{i}" for i in range(6)]
    again = ["reset", "r_3"]
    assert offset_method.calls[:5] == ["fit", "reset", "r_0", "r_5", "reset"]
    assert offset_method.calls[5:] == [*sequence, *again, *again]
    assert len(measured.frames) == 6
    assert measured.record["doubts"] == []


def test_frames_with_too_little_to_look_back_on_are_cold(run, offset_method, tiny_scene):
    offset_method.memory = 2
    whole = from_split(tiny_scene)
    steps = tuple(replace(s, cut=i == 3) for i, s in enumerate(whole.steps))
    measured = run(offset_method, trajectory=replace(whole, steps=steps))
    frames, rows = measured.frames, measured.rows
    assert frames["phase"].tolist() == ["cold", "cold", "steady", "cold", "cold", "steady"]
    for phase, of_phase in frames.groupby("phase"):
        of_rows = rows[rows["phase"] == phase]
        for metric in ("psnr", "frame_ms", "work.pixels", "stage_ms.look-up"):
            found = row(of_rows, metric)
            assert (found["value"], found["n"]) == (of_phase[metric].mean(), len(of_phase))
        for part in (50, 95, 99):
            quantile = of_phase["frame_ms"].quantile(part / 100)
            assert value(of_rows, f"frame_ms.p{part}") == pytest.approx(quantile)
        assert value(of_rows, "fps") == pytest.approx(1000 / of_phase["frame_ms"].mean())
    whole = rows.loc[rows["phase"] == "all", "metric"]
    assert set(whole) == {
        *("size_bytes.offset", "size_bytes.table", "size_bytes.total"),
        *("peak_bytes", "train_s", "train_peak_bytes"),
    }
    assert not rows.duplicated(["phase", "metric"]).any()
    assert offset_method.calls.count("reset") == 4  # of no cut: warm-up, path, and twice alone


@pytest.mark.parametrize(("memory", "phase"), [(0, "steady"), (6, "cold")])
def test_phases_there_are_none_of_have_no_rows(run, offset_method, memory, phase):
    offset_method.memory = memory
    measured = run(offset_method)
    assert set(measured.frames["phase"]) == {phase}
    assert set(measured.rows["phase"]) == {phase, "all"}


@pytest.mark.parametrize(
    ("of_process", "warmup", "metered"),
    [
        (True, 0, ["r_0"]),
        (True, 1, ["r_0"]),
        (True, 2, ["r_5"]),  # the first frame may compile kernels
        (False, 2, [f"r_{i}" for i in range(6)]),
    ],
)
def test_the_memory_of_a_process_is_measured_before_scoring_leaves_any_in_it(
    run, offset_method, monkeypatch, of_process, warmup, metered
):
    class Meter:
        peak_bytes, source = 0, "memory"

        def __init__(self, device):
            self.of_process = of_process

        def __enter__(self):
            self.before = len(offset_method.calls)

        def __exit__(self, *_):
            self.peak_bytes += 1
            regions.extend(offset_method.calls[self.before :])

    regions: list[str] = []
    monkeypatch.setattr(bench.measure, "MemoryMeter", Meter)
    run(offset_method, protocol=replace(PROTOCOL, warmup=warmup))
    assert regions == metered


def test_flicker_has_a_row_in_the_phases_that_have_a_pair(run, offset_method, tiny_scene):
    offset_method.memory = 1
    measured = run(offset_method)
    found = row(measured.rows, "flicker")
    assert (found["phase"], found["n"], found["unit"]) == ("steady", 5, "1")
    known = measured.frames["flicker"]
    assert math.isnan(known[0])
    assert found["value"] == pytest.approx(known[1:].mean())
    alone = run(offset_method, trajectory=from_split(tiny_scene, limit=1))
    assert "flicker" not in set(alone.rows["metric"])
    assert alone.frames["flicker"].isna().all()


def test_a_backbone_that_cannot_be_had_leaves_nan_and_its_reason(run, offset_method, monkeypatch):
    loaded = {"alex": lambda image, truth: 0.5}, {"lpips_vgg": "no network"}
    monkeypatch.setattr(EvaluationProtocol, "load_lpips", lambda *_: loaded)
    measured = run(offset_method, protocol=STEERBENCH_1)
    assert (row(measured.rows, "lpips_alex")["n"], row(measured.rows, "lpips_vgg")["n"]) == (6, 0)
    assert value(measured.rows, "lpips_alex") == 0.5
    assert math.isnan(value(measured.rows, "lpips_vgg"))
    assert measured.record["missing"] == loaded[1]
    assert list(measured.frames)[3:7] == ["psnr", "ssim", "lpips_alex", "lpips_vgg"]


def without_truth(scene: Scene, count: int) -> Trajectory:
    """The test split as a path whose first frames have no ground truth."""
    whole = from_split(scene)
    steps = (replace(s, truth=None) if i < count else s for i, s in enumerate(whole.steps))
    return replace(whole, steps=tuple(steps))


def test_frames_without_ground_truth_are_timed_but_not_scored(run, offset_method, tiny_scene):
    measured = run(offset_method, trajectory=without_truth(tiny_scene, 4))
    assert row(measured.rows, "psnr")["n"] == 2
    assert row(measured.rows, "frame_ms")["n"] == 6
    unscored = run(offset_method, trajectory=without_truth(tiny_scene, 6))
    assert math.isnan(value(unscored.rows, "psnr"))


def test_the_exact_picture_serves_flicker_when_the_protocol_asks(run, offset_method, tiny_scene):
    asked = []

    def exact(camera):
        asked.append(camera)
        return torch.full((camera.height, camera.width, 4), 255, dtype=torch.uint8)

    scene, protocol = replace(tiny_scene, exact=exact), replace(PROTOCOL, flicker="exact")
    given = {"scene": scene, "trajectory": without_truth(tiny_scene, 6)}
    frames = run(offset_method, protocol=protocol, **given).frames
    assert frames["flicker"].notna().tolist() == [False, *[True] * 5]
    assert len(asked) == 6
    assert run(offset_method, **given).frames["flicker"].isna().all()  # "split"
    run(offset_method, scene=scene, protocol=protocol)  # ground truth is there
    assert len(asked) == 6


def test_pictures_show_ground_truth_rendering_and_error(run, offset_method):
    pictures = run(offset_method).pictures
    assert list(pictures) == [
        f"{number}-{kind}"
        for number in ("0000", "0002", "0005")
        for kind in ("truth", "rendered", "error")
    ]
    truth, rendered = (pictures[f"0000-{kind}"].astype(int) for kind in ("truth", "rendered"))
    assert truth.shape == rendered.shape == pictures["0000-error"].shape == (32, 40, 3)
    assert set(np.unique((rendered - truth)[truth < 247])) <= {7, 8, 9}  # two roundings
    for count, kept in ((0, []), (2, [0, 5]), (99, [0, 1, 2, 3, 4, 5])):
        found = run(offset_method, pictures=count).pictures
        assert sorted({int(name[:4]) for name in found}) == kept


def test_a_rendering_with_nan_in_it_stops_the_run(run, offset_method):
    def broken(camera, probe):
        frame = type(offset_method).render(offset_method, camera, probe)
        frame.rgb[3, 4, 1] = math.nan
        return frame

    offset_method.render = broken
    with pytest.raises(SteerbenchError, match="offset rendered 1 of 1280 pixels of frame 0"):
        run(offset_method)


def test_what_cannot_be_scored_or_compared_stops_the_run_before_training(
    run, offset_method, tiny_scene
):
    with pytest.raises(SteerbenchError, match="background"):
        run(offset_method, scene=replace(tiny_scene, background=torch.zeros(3)))
    offset_method.memory = 99
    with pytest.raises(SteerbenchError, match="99 frames before it"):
        run(offset_method, protocol=IN_ROUNDS)
    assert offset_method.calls == []


def test_frames_are_let_go_once_they_are_scored(run, offset_method):
    alive: list[weakref.ref] = []
    most = 0

    def watched(camera, probe):
        nonlocal most
        most = max(most, sum(reference() is not None for reference in alive))
        frame = type(offset_method).render(offset_method, camera, probe)
        alive.append(weakref.ref(frame.rgb))
        return frame

    offset_method.render = watched
    run(offset_method)
    assert len(alive) == 10
    assert most <= 1


def test_methods_in_turns_draw_frames_as_if_alone(run, offset_method):
    other = OffsetMethod(offset_method.settings()["device"], 16 / 255)
    drawn = []
    for name, method in (("one", offset_method), ("other", other)):

        def watched(camera, probe, name=name, method=method):
            drawn.append(name)
            return type(method).render(method, camera, probe)

        method.render = watched
    both = run(offset_method, other)
    in_turns = ["one", "other"] * (PROTOCOL.warmup + 6)
    assert drawn == [*in_turns, "one", "one", "other", "other"]
    for method, measured in zip((offset_method, other), both, strict=True):
        assert measured.frames["psnr"].tolist() == run(method).frames["psnr"].tolist()
    assert value(both[0].rows, "psnr") > value(both[1].rows, "psnr")


@pytest.mark.parametrize("where", ["fit", "reset", "render", "sizes"])
def test_of_several_methods_the_one_that_failed_is_named(where, run, offset_method, monkeypatch):
    other, error = OffsetMethod("cpu", 16 / 255), RuntimeError("no")

    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr(other, where, failing)
    with pytest.raises(MethodFailed) as caught:
        run(offset_method, other)
    assert caught.value.method is other
    assert caught.value.__cause__ is error
    with pytest.raises(RuntimeError, match="no"):
        run(other)


# What passes for a measurement


def rendering(method, change):
    """`method`, with `change` made to the frames that it renders; it gets frame and camera, too."""

    def render(camera, probe):
        frame = type(method).render(method, camera, probe)
        return change(frame, camera) or frame

    method.render = render
    return method


def test_a_camera_that_a_method_writes_to_is_its_own(run, offset_method, tiny_scene):
    poses = [camera.c2w.clone() for camera in tiny_scene.splits["test"].cameras]

    def turn(frame, camera):
        camera.c2w[:, 1:3] *= -1  # from OpenCV's axes to OpenGL's

    run(rendering(offset_method, turn))
    assert all(map(torch.equal, poses, (x.c2w for x in tiny_scene.splits["test"].cameras)))


@pytest.mark.parametrize("when", ["fit", "render"])
def test_a_method_that_changes_the_pictures_that_it_is_scored_on_is_refused(
    when, run, offset_method, tiny_scene, monkeypatch
):
    usual = getattr(offset_method, when)

    def spoiling(*given):
        tiny_scene.splits["test"].images[3].fill_(7)
        return usual(*given)

    monkeypatch.setattr(offset_method, when, spoiling)
    with pytest.raises(SteerbenchError, match="offset changed pictures of tiny in place"):
        run(offset_method)


def test_of_several_methods_the_one_that_changed_pictures_while_it_learnt_is_named(
    run, offset_method, tiny_scene, monkeypatch
):
    def spoiling(scene, budget, log):
        scene.splits["test"].images[3].bitwise_not_()

    monkeypatch.setattr(offset_method, "fit", spoiling)
    with pytest.raises(MethodFailed) as caught:
        run(OffsetMethod("cpu", 0.0), offset_method)
    assert caught.value.method is offset_method


def test_a_frame_is_what_it_was_when_it_was_returned(run, offset_method):
    """What still writes into it afterwards changes no score and no kept picture."""
    last: list[torch.Tensor] = []

    def late(frame, camera):
        for earlier in last:
            earlier.fill_(0)
        last[:] = [frame.rgb]

    usual = run(OffsetMethod("cpu", 8 / 255))
    found = run(rendering(offset_method, late))
    assert found.frames["psnr"].tolist() == usual.frames["psnr"].tolist()
    assert all(map(np.array_equal, found.pictures.values(), usual.pictures.values()))


def test_no_frame_is_timed_that_a_method_may_have_kept(run, offset_method):
    """In warm-up and in timed rounds no pose is that of a frame before; scored ones are exact."""
    seen: list[bytes] = []

    def note(frame, camera):
        seen.append(camera.c2w.numpy().tobytes())

    in_rounds = replace(PROTOCOL, rounds=3)
    run(rendering(offset_method, note), protocol=in_rounds)
    timed, again = seen[: 2 + 3 * 6], seen[2 + 3 * 6 :]
    assert len(set(timed)) == len(timed)
    assert set(again) == {seen[2 + 3]}


def test_a_method_without_memory_that_is_random_or_looks_back_is_doubted(run, quiet_log):
    def noisy(frame, camera):
        frame.rgb.sub_(torch.rand(()) / 10)

    calls = itertools.count()

    def looking_back(frame, camera):
        frame.rgb.sub_(0.02 if next(calls) < 8 else 0.0)  # until the path has ended

    random = run(rendering(OffsetMethod("cpu", 0.0), noisy))
    assert random.record["doubts"] == [
        "it renders one view in several ways: its pictures are random"
    ]
    back = run(rendering(OffsetMethod("cpu", 0.0), looking_back))
    assert "depend on the frames before" in back.record["doubts"][0]
    remembering = OffsetMethod("cpu", 0.0)
    remembering.memory = 1
    assert run(rendering(remembering, noisy)).record["doubts"] == random.record["doubts"]
    assert run(rendering(remembering, lambda frame, camera: None)).record["doubts"] == []


@pytest.mark.parametrize(
    ("share", "transfer", "doubted"), [(0.9, 0.0, False), (0.1, 0.0, True), (0.1, 0.85, False)]
)
def test_reported_times_far_below_what_passed_here_are_doubted_in_every_row(
    share, transfer, doubted
):
    passed = 100_000_000
    of = {"wall_ns": passed, "transfer_ns": int(transfer * passed)}
    records = [FrameRecord({"other": int(share * passed)}, {}, {}, **of)] * 2
    assert bool(bench.measure._doubted_times(records)) == doubted
    # Honest frames hide no others, and one pause of the system is no reason.
    honest = FrameRecord({"other": passed}, {}, {}, wall_ns=passed)
    assert bool(bench.measure._doubted_times([*records, *[honest] * 8])) == doubted
    assert not bench.measure._doubted_times([*records[:1], *[honest] * 10])
    # As large a share of a short frame is the rounding of clocks.
    short = FrameRecord({"other": 10_000}, {}, {}, wall_ns=500_000)
    assert not bench.measure._doubted_times([short])
    quick = FrameRecord({"other": 1_000}, {}, {}, wall_ns=1_100_000)
    assert bench.measure._doubted_times([quick] * 2)
    assert not bench.measure._doubted_times([quick, honest, honest])
    assert not bench.measure._doubted_times([frame(1.0)])  # which nobody reported


def test_a_reported_time_that_is_doubted_is_of_no_other_device(run, offset_method, monkeypatch):
    monkeypatch.setattr(bench.measure, "_doubted_times", lambda records: "ticks?")
    found = run(offset_method)
    assert set(found.rows["device"]) == {f"{offset_method.settings()['device']}, doubtful times"}
    assert found.record["doubts"] == ["ticks?"]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sizes", lambda: {"table": -1}),
        ("sizes", lambda: {"table": 1.5}),
        ("train_s", -1.0),
        ("train_s", math.inf),
        ("train_peak_bytes", -1),
        ("memory", -1),
        ("memory", 0.5),
    ],
)
def test_costs_that_cannot_be_are_refused_by_name(name, value, run, offset_method):
    offset_method.fit = lambda *given: (
        type(offset_method).fit(offset_method, *given) or setattr(offset_method, name, value)
    )
    if name == "memory":
        offset_method.memory = value
    with pytest.raises(SteerbenchError, match="offset: "):
        run(offset_method)


def test_the_seconds_of_compiling_are_a_figure_of_their_own(run, offset_method):
    assert "compile_s" not in set(run(offset_method).rows["metric"])
    offset_method.compile_s = 3.5
    rows = run(offset_method).rows
    assert (value(rows, "compile_s"), value(rows, "train_s")) == (3.5, 12.5)
    assert row(rows, "compile_s")["unit"] == "s"


# In rounds, compared with the first


IN_ROUNDS = replace(PROTOCOL, warmup=0, rounds=3, compared=True)


@pytest.fixture
def in_turns(run, tiny_scene):
    """What was measured in rounds of a method that renders the truth, half as bright, and of one
    that is 8 levels brighter; and who had which turn."""
    test = tiny_scene.splits["test"]
    dark = replace(test, images=[image[..., :3] // 2 for image in test.images])
    scene = replace(tiny_scene, splits={**tiny_scene.splits, "test": dark})

    def rendered(**changes):
        methods = OffsetMethod("cpu", 0.0), OffsetMethod("cpu", 8 / 255)
        methods[1].calls = methods[0].calls
        found = run(*methods, **{"scene": scene, "protocol": IN_ROUNDS, **changes})
        return found, methods[0].calls

    return rendered


def test_methods_take_turns_in_every_round_and_are_held_against_the_first(in_turns):
    (first, second), calls = in_turns()
    round_ = ["reset", *(f"r_{number}" for number in range(6))]
    rounds = [call for call in ("fit", "reset", *3 * round_) for _ in (first, second)]
    assert calls == [*rounds, *4 * ("reset", "r_3")]
    assert value(first.rows, "psnr_to_first") == math.inf
    assert value(first.rows, "worst_to_first") == 0
    apart, worst = (value(second.rows, f"{x}_to_first") for x in ("psnr", "worst"))
    assert (apart, worst) == pytest.approx((20 * math.log10(255 / 8), 8 / 255))
    for each in (first, second):
        ms, *ends = (value(each.rows, f"frame_ms{x}") for x in ("", ".fastest", ".slowest"))
        # Two ways to add up the same times.
        assert 0 < ends[0] <= ms * (1 + 1e-12)
        assert ms <= ends[1] * (1 + 1e-12)


def test_a_single_round_names_no_other_and_no_first(run, offset_method):
    named = set(run(offset_method).rows["metric"])
    assert not {"frame_ms.fastest", "psnr_to_first", "worst_to_first"} & named


def test_times_are_those_of_the_median_round_without_the_first_and_what_is_not_steady():
    take = object.__new__(_Take)
    take.rows = [{"phase": phase} for phase in ("cold", "steady", "steady")]
    warm, first = [frame(9.0)], [frame(1000.0), frame(500.0), frame(500.0)]
    slow = [frame(1000.0), frame(40.0), frame(60.0)]
    usual = [frame(1000.0), frame(14.0), frame(14.0)]
    fast = [frame(1000.0), frame(8.0), frame(8.0)]
    take.clock = SimpleNamespace(frames=[*warm, *first, *slow, *usual, *fast])
    assert take.timed(1) == (usual, [50.0, 14.0, 8.0])
    take.clock = SimpleNamespace(frames=[*warm, *first, *slow, *usual])
    assert take.timed(1)[0] == usual  # the lower of two
    take.clock = SimpleNamespace(frames=[*warm, *first])
    assert take.timed(1) == (first, [500.0])  # the only round


def frame(ms: float) -> FrameRecord:
    return FrameRecord({"field": int(ms * 1e6)}, {}, {})


def test_only_steady_frames_with_a_ground_truth_are_held_against_the_first(in_turns, tiny_scene):
    whole = from_split(tiny_scene)
    blind = replace(whole, steps=(whole.steps[0], replace(whole.steps[1], truth=None)))
    alone = replace(whole, steps=whole.steps[:1])
    # Bright pictures are clipped, each in other places.
    found = [in_turns(scene=tiny_scene, trajectory=path)[0][1].rows for path in (blind, alone)]
    assert value(found[0], "psnr_to_first") == value(found[1], "psnr_to_first")
