"""The benchmark of large captures: its frames are of the subject that they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.importing.large_sizes import SIZES
from benchmarks.importing.painted import NOISE, PaintedCapture
from scipy.spatial import cKDTree

from reconstruction.images.silhouettes import silhouette
from reconstruction.light_planes import triangulate
from simulators.subject.subject import make_subject


@pytest.mark.slow
def test_painted_frames_show_the_subject_where_it_is(tmp_path):
    rig = replace(SIZES["small"], cameras=2, lights=6, scaled=0.1, sweep=True).rig()
    rig = replace(rig, projectors=rig.projectors[:1])
    capture = PaintedCapture.write(tmp_path, rig, sweep=True, all_on=True)
    camera = capture.rig.cameras[0]
    assert (camera.width, camera.height) == (130, 103)
    dark = capture.frame(capture.of_kind("dark")[0], camera.name)
    assert abs(float(dark.std()) - NOISE) < 0.05 * NOISE
    strands = make_subject("wavy", 0).strands
    inside, x, y, _ = camera.pixels_of(strands.points)
    shown = silhouette(capture, camera.name)
    assert inside.all()
    assert shown[y, x].mean() > 0.97
    assert capture.view(reduced=2).frame(capture.steps[1], camera.name).shape == (51, 65, 3)
    # what the projector's rows show is where strands are
    cloud = triangulate(capture)
    assert len(cloud) > 300
    near, _ = cKDTree(strands.points).query(cloud.points[::20])
    assert np.median(near) < 2.8e-3  # a pixel
