"""The benchmark of fields on a subject that a test can afford."""

from __future__ import annotations

import pytest
from benchmarks.fields.frames import frames_of
from benchmarks.fields.modulation import FIELDS, SIZES, rows_of
from benchmarks.subjects import Subject

from appearance import HairAppearance
from appearance.fields.validation import GROUPS
from reconstruction import silent


@pytest.mark.slow
def test_rows_are_of_pictures_that_no_fit_saw(small):
    hair = HairAppearance((0.1, 0.2, 0.4), 0.28, 0.3)
    subject = Subject(small.tuft(150).resampled(4e-3), None, hair, (0.3, 0.3, 0.3))
    frames = frames_of(subject, SIZES["quick"], 0)
    training = frames.training()
    assert len(training) == len(frames.pictures) - len(frames.held_views)
    held = {frames.pictures[0].lights[i].name for i in frames.held_lights}
    assert not held & {light.name for p in training for light in p.lights}
    perfect = frames.psnr(dict(enumerate(frames.true)))
    assert all(perfect[g] == pytest.approx(60) for g in GROUPS)
    name = "modulation, degree 0"
    rows = rows_of(frames, {name: FIELDS[name]}, silent)
    assert {"mean colour", "inverse rendering", "three nearest lights", name} <= set(rows)
    assert set(rows["three nearest lights"]) == {GROUPS[0]}
