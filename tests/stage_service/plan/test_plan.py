"""Plans: order, cost and refusals."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Rig
from stage_service.config import RigFile, load_rig_file
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import PlanError, resolve

RIGS = Path(__file__).resolve().parents[3] / "stage_service" / "rigs"


@pytest.fixture(scope="module")
def demo() -> RigFile:
    return load_rig_file(RIGS / "demo.toml")


@pytest.fixture(scope="module")
def stage331() -> RigFile:
    return load_rig_file(RIGS / "stage331.toml")


def test_the_default_plan_of_the_demonstration(demo):
    steps = resolve(CapturePlan(), demo).steps
    kinds = [s.kind for s in steps]
    assert kinds[:3] == ["dark", "all_on", "olat"]
    assert kinds[-2:] == ["dark", "all_on"]
    assert [s.index for s in steps] == list(range(len(steps)))
    assert [s.light for s in steps if s.kind == "olat"] == [x.name for x in demo.rig.lights]
    assert kinds.count("scanline") == 3 * 64
    assert kinds.count("tracking") == 3 * 6
    assert kinds.index("tracking") == kinds.index("scanline") - 1


def test_a_tracking_frame_stands_before_each_full_group_of_ten(demo):
    steps = resolve(CapturePlan(lights=(), sentinels=False, projectors=("proj_1",)), demo).steps
    rows_after = [steps[i + 1].row for i, s in enumerate(steps) if s.kind == "tracking"]
    assert rows_after == [0, 10, 20, 30, 40, 50]


def test_lit_frames_stand_among_single_lights_and_after_them(demo):
    plan = CapturePlan(lights=("light_000", "light_001", "light_002"), sentinels=False,
                       projectors=(), lit_every=2, brackets=(1.0, 4.0))  # fmt: skip
    kinds = [s.kind for s in resolve(plan, demo).steps]
    bracket = ["all_on", "olat", "olat", "all_on", "olat"]
    assert kinds == [*bracket, *bracket, "all_on"]


def test_photobooth_counts_as_in_the_paper(stage331):
    rig = stage331.rig
    sixteen = replace(stage331, rig=Rig("booth", rig.cameras[:16], (), rig.projectors))
    cost = resolve(CapturePlan(lights=(), sentinels=False), sixteen).cost
    assert cost.frames_by_kind == {"tracking": 3648, "scanline": 36864}
    assert cost.frames == 40512


def test_bytes_are_those_of_the_files(demo, tmp_path):
    from reconstruction import CaptureWriter

    plan = CapturePlan(lights=("light_007",), projectors=(), sentinels=False)
    writer = CaptureWriter.create(tmp_path / "c", demo.rig, {"steps": resolve(plan, demo).steps})
    for camera in demo.rig.cameras:
        image = np.zeros((camera.height, camera.width, 3), np.float32)
        writer.write_frame(writer.steps[0], camera.name, image, full_scale=1.0, count_scale=0.1)
    writer.close()
    size = sum(f.stat().st_size for f in tmp_path.rglob("*.exr"))
    assert resolve(plan, demo).cost.bytes == pytest.approx(size, rel=0.01)


def test_dose_follows_the_inverse_square_law(demo):
    light = demo.rig.lights[5]
    plan = CapturePlan(
        lights=(light.name,),
        projectors=(),
        sentinels=False,
        exposure={"olat": 1.0},
        level={"olat": 0.5},
    )
    cost = resolve(plan, demo).cost
    distance = np.linalg.norm(light.position)
    np.testing.assert_allclose(cost.dose, 0.5 * light.intensity / distance**2, rtol=3e-3)
    assert cost.lamp_seconds == pytest.approx(0.5, rel=3e-3)


def test_exposure_and_level_are_the_plan_s_then_the_rig_file_s(demo):
    plan = CapturePlan(lights=("light_000",), exposure={"olat": 0.5}, level={"tracking": 0.3})
    by_kind = {s.kind: (s.exposure, s.level) for s in resolve(plan, demo).steps}
    assert by_kind["olat"] == (0.5, demo.capture.level.olat)
    assert by_kind["tracking"] == (demo.capture.exposure.tracking, 0.3)
    assert by_kind["dark"][1] == 0.0


@pytest.mark.parametrize(
    ("plan", "problem"),
    [
        ({"lights": ("light_000", "lamp")}, "lights: the rig has no light 'lamp'"),
        ({"lights": ("light_001", "light_001")}, "'light_001' is listed twice"),
        ({"projectors": ("beamer",)}, "projectors: the rig has no projector 'beamer'"),
        ({"rows": {"last": 64}}, "projector proj_0 has rows 0 to 63"),
        ({"rows": {"first": 9, "last": 3}}, "rows 9 to 3"),
        ({"lights": (), "projectors": (), "sentinels": False}, "the plan has no steps"),
    ],
)
def test_plans_beyond_the_rig_are_refused(demo, plan, problem):
    with pytest.raises(PlanError) as error:
        resolve(CapturePlan(**plan), demo)
    assert problem in str(error.value)


class Counted(str):
    """A name that counts how often it is compared."""

    compared = 0

    def __eq__(self, other: object) -> bool:
        Counted.compared += 1
        return str.__eq__(self, other)

    __hash__ = str.__hash__


def test_a_full_disk_is_reported_with_the_space_that_the_plan_needs(demo, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=270_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    need = r"writes 1\.35 GB and keeps a reserve of 0\.27 GB, but .* has 0\.27 GB free: make room"
    with pytest.raises(PlanError, match=need):
        resolve(CapturePlan(), demo).check_room(tmp_path)


def test_many_names_that_the_rig_lacks_are_not_compared_with_each_other(demo):
    names = tuple(Counted(f"lamp_{i}") for i in range(2000))
    plan = CapturePlan().model_copy(update={"lights": names})
    with pytest.raises(PlanError) as error:
        resolve(plan, demo)
    assert str(error.value).count("\n") < 30
    assert Counted.compared < 10 * len(names)


def test_without_a_projector_the_sweep_is_skipped_and_reported(demo):
    without = replace(demo, rig=Rig("dome", demo.rig.cameras, demo.rig.lights))
    cost = resolve(CapturePlan(), without).cost
    assert "scanline" not in cost.frames_by_kind
    (left_out,) = cost.left_out
    assert (left_out.what, left_out.why) == ("scanline sweep", "the rig has no projector")


def test_no_projector_controller_leaves_the_sweep_out(demo):
    assert demo.devices is not None
    bare = replace(demo, devices=demo.devices.model_copy(update={"projectors": None}))
    (left_out,) = resolve(CapturePlan(), bare).cost.left_out
    assert left_out.saved == f"{3 * 64 * 8} frames"
    with pytest.raises(PlanError, match=r"no \[devices.projectors\]"):
        resolve(CapturePlan(projectors=("proj_0",)), bare)
