"""Stage 1 on a capture: what it leaves in the model folder, and going on after a kill."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.pipeline import Stage1Request, fit_stage1
from appearance.metrics.scores import Exposure
from appearance.model.fitted_appearance import FittedAppearance
from appearance.observations import HeldOut
from appearance.scene.hair_appearance import HairAppearance
from reconstruction.capture.folder import Capture, Step
from reconstruction.capture.writer import CaptureWriter
from reconstruction.files.strands import write_strands
from reconstruction.geometry.rig import Rig
from reconstruction.report.report import Report

REQUEST = Stage1Request(
    judged_spp=4,
    fit={
        "row": "correctives",
        "steps": 12,
        "shape": [2, 2, 2],
        "check_every": 5,
        "effort": {"pixels": 60, "spp": 8, "gradient_spp": 2, "max_depth": 5},
    },
)
HELD_OUT = HeldOut(lights=("l1", "l3"))


@pytest.fixture(scope="module")
def made(plain, tufted, tmp_path_factory):
    """The tuft's frames as a capture, and a model that Sun's fit has left."""
    folder = tmp_path_factory.mktemp("stage1")
    cameras = tuple(o.camera for o in plain.views)
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(plain.lights)]
    writer = CaptureWriter.create(
        folder / "capture",
        Rig("tuft", cameras, plain.lights),
        {"steps": [s.to_dict() for s in steps]},
    )
    model = folder / "model"
    (model / "masks").mkdir(parents=True)
    write_strands(model / "strands.npz", tufted.strands)
    for o in plain.views:
        size = (o.camera.height, o.camera.width)
        mask = np.zeros(size, bool)
        mask.reshape(-1)[o.pixels] = True
        cv2.imwrite(str(model / "masks" / f"{o.camera.name}_hair.png"), mask.astype(np.uint8) * 255)
        for step, values in zip(steps, o.radiance, strict=True):
            image = np.zeros((*size, 3), np.float32)
            image[mask] = values
            writer.write_frame(step, o.camera.name, image, pulse=1, block_id=1, timestamp=0.0)
    writer.finish("completed", {})
    start = HairAppearance((0.2, 0.2, 0.2), 0.4, 0.3)
    skin = (0.3, 0.3, 0.3)
    FittedAppearance(start, skin, skin, Exposure(plain.scale), 0.1, 0.1, 0.1).save(model)
    return Capture(folder / "capture"), model


def test_a_killed_fit_goes_on_and_leaves_maps_lamps_and_figures(made):
    capture, model = made
    told = []

    def killed(what, share):
        told.append((what, share))
        if what.startswith("step 10"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_stage1(capture, model, held_out=HELD_OUT, request=REQUEST, progress=killed)
    assert (model / "stage1-correctives.checkpoint.npz").is_file()
    again = []
    result = fit_stage1(
        capture,
        model,
        held_out=HELD_OUT,
        request=REQUEST,
        progress=lambda what, share: again.append((what, share)),
    )
    steps = [what for what, _ in again if what.startswith("step")]
    assert steps[-1].startswith("step 10: error 0.")
    assert [share for _, share in again] == sorted(share for _, share in again)
    assert result["error"] <= result["start_error"]
    assert set(result["held_out"]) == {"start", "stage1"}
    picture = cv2.imread(str(model / "stage1.png"))
    # four frames, each captured, before, after and its error map
    assert picture.shape[0] > 3.5 * picture.shape[1] / 4
    maps, uv = HairMaps.load(model / "hair_maps.npz")
    assert maps.shape == (2, 2, 2)
    assert abs(maps.beta_m - 0.25) < abs(0.4 - 0.25) / 2
    assert uv.shape == (300, 2)
    lamps = json.loads((model / "lamps.json").read_text())
    assert [x["name"] for x in lamps] == ["l0", "l2", "l4", "l5", "l6", "l7"]
    assert all(x["gain"] == 1 for x in lamps)
    assert not list(model.glob("*.checkpoint.npz"))
    stage = Report.load(model / "report.json")["stage1"]
    assert [s.name for s in stage.series] == ["stage 1, original", "stage 1, correctives"]


def test_unknown_fields_of_the_fit_are_refused_by_name(made):
    capture, model = made
    with pytest.raises(TypeError, match="stepps"):
        fit_stage1(capture, model, request=Stage1Request(fit={"stepps": 3}))
