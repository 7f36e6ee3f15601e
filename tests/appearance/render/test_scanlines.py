"""Scanline sweeps against the light planes' geometry."""

import numpy as np
import pytest

from appearance import HairAppearance, build_scene, render_olat, render_scanlines
from reconstruction import Camera, Light, Projector

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)
ALBEDO = np.array([0.35, 0.25, 0.2])


def projector(name="proj", position=(0.3, -0.3, 0.8), fov_deg=20.0, **more):
    return Projector.look_at(
        name,
        16,
        16,
        position,
        (0, 0, 0),
        fov_deg,
        roll_deg=25.0,
        intensity=np.array([20.0, 10.0, 5.0]),
        **more,
    )


@pytest.fixture(scope="module")
def floor(small):
    return build_scene(small.no_hair, small.plane(), hair=HAIR, skin=ALBEDO)


@pytest.fixture(scope="module")
def above():
    return Camera.look_at("cam", 32, 32, (-0.1, -0.2, 0.9), (0, 0, 0), 18)


def analytic(camera, source, fine=8):
    """Radiance of each row on the floor, `(rows, H, W, 3)`: a pixel's mean over fine² points."""
    at = (np.arange(fine) + 0.5) / fine - 0.5
    column = (np.arange(camera.width)[:, None] + at).ravel()
    row = (np.arange(camera.height)[:, None] + at).ravel()
    rays = camera.rays(np.stack(np.meshgrid(column, row), -1))
    hit = camera.center - rays * (camera.center[2] / rays[..., 2])[..., None]
    uv, _ = source.project(hit)
    towards = source.center - hit
    d2 = (towards**2).sum(-1)
    inside = (uv[..., 0] >= -0.5) & (uv[..., 0] < source.width - 0.5)
    full = (towards[..., 2] / d2**1.5 * inside)[..., None] * ALBEDO / np.pi * source.intensity
    weight = source.row_weight(np.arange(source.height)[:, None, None], uv[..., 1])
    fine_rows = weight[..., None] * full
    shape = (source.height, camera.height, fine, camera.width, fine, 3)
    return fine_rows.reshape(shape).mean((2, 4))


def test_rows_on_a_plane_are_the_closed_form(floor, above):
    projectors = [projector(), projector("other", (-0.5, 0.2, 0.7), 12.0, line_sigma=1.1)]
    swept = render_scanlines(floor, above, projectors, spp=256, thrift=0)
    for source in projectors:
        expected = analytic(above, source)
        assert swept[source.name].shape == expected.shape
        peak = expected.max((0, 1, 2))
        assert np.abs(swept[source.name] - expected).max() < 0.09 * peak.max()
        assert np.sqrt(((swept[source.name] - expected) ** 2).mean()) < 0.004 * peak.max()
        np.testing.assert_allclose(
            swept[source.name].sum((1, 2)), expected.sum((1, 2)), rtol=0.01, atol=0.05 * peak.max()
        )


def test_rows_sum_to_the_projector_as_a_light(small):
    """Where the frustum holds the whole subject, all rows are a point light, on hair too."""
    dark = HairAppearance((1.0, 1.5, 2.0), 0.3, 0.3)  # little multiple scattering, little noise
    scene = build_scene(small.tuft(), None, hair=dark)
    source = projector(position=(0.4, -0.8, 0.3))
    camera = small.camera()
    light = Light("point", source.center, source.intensity)
    all_on = render_scanlines(scene, camera, [source], spp=256, max_depth=6)["proj"].sum(0)
    point = render_olat(scene, camera, [light], spp=512, max_depth=6)[0]
    np.testing.assert_allclose(all_on.mean((0, 1)), point.mean((0, 1)), rtol=0.03)


def test_shadow_rays_by_roulette_keep_the_mean(small):
    scene = build_scene(small.tuft(), small.plane(), hair=HAIR)
    camera, source = small.camera(), projector()
    means = [
        render_scanlines(scene, camera, [source], spp=256, thrift=t)["proj"].sum(0).mean((0, 1))
        for t in (0.0, 2.0)
    ]
    np.testing.assert_allclose(means[0], means[1], rtol=0.03)


def test_a_range_of_rows_is_that_part_of_the_sweep(floor, above):
    projectors = [projector(), projector("other", (-0.5, 0.2, 0.7))]
    whole = render_scanlines(floor, above, projectors, spp=4, thrift=0)
    part = render_scanlines(
        floor, above, projectors, spp=4, thrift=0, rows={"proj": range(5, 9), "other": range(0)}
    )
    np.testing.assert_allclose(part["proj"], whole["proj"][5:9], rtol=1e-5, atol=1e-4)
    assert part["other"].shape == (0, 32, 32, 3)


def test_many_tiles_make_up_the_sweep(floor, above):
    how = {"spp": 64, "max_depth": 1, "thrift": 0}
    one, many = (
        render_scanlines(floor, above, [projector()], **how, **more)["proj"]
        for more in ({}, {"memory": 1 << 18})
    )
    np.testing.assert_allclose(many.sum((1, 2)), one.sum((1, 2)), rtol=0.02, atol=0.05 * one.max())


def test_bad_arguments_are_refused(floor, above):
    with pytest.raises(ValueError, match="unknown projectors"):
        render_scanlines(floor, above, [projector()], rows={"nobody": range(3)})
    with pytest.raises(ValueError, match="rows must be a range"):
        render_scanlines(floor, above, [projector()], rows={"proj": range(10, 17)})
    with pytest.raises(ValueError, match="greater than 0"):
        render_scanlines(floor, above, [projector()], spp=0)
