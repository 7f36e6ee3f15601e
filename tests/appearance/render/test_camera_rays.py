"""Camera rays: known points are rendered where `Camera.project` puts them, through any lens."""

import numpy as np
import pytest
from scipy.special import ndtr

from appearance import HairAppearance, build_scene
from appearance.render.coverage import coverage
from reconstruction import Camera, Mesh

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)
BARREL = (-0.3, 0.12, 2e-3, -1.5e-3, -0.02)
PIXELS = np.array([[7.3, 6.8], [56.9, 8.2], [31.5, 24.5], [9.1, 41.7], [54.4, 39.6]])


def discs(camera, radius_pixels, depth=1.0):
    """Flat discs across the camera's axis, whose middles project to `PIXELS`, and their middles."""
    centres = camera.rays(PIXELS)
    centres = camera.center + centres * (depth / (centres @ camera.R[2]))[:, None]
    angle = np.linspace(0, 2 * np.pi, 65)[:-1]
    radius = radius_pixels * depth / camera.K[0, 0]
    ring = radius * (np.cos(angle)[:, None] * camera.R[0] + np.sin(angle)[:, None] * camera.R[1])
    vertices, faces = [], []
    for i, centre in enumerate(centres):
        vertices += [centre[None], centre + ring]
        first = 65 * i
        rim = first + 1 + np.arange(64)
        faces.append(np.stack([np.full(64, first), rim, np.roll(rim, -1)], -1))
    return Mesh(np.concatenate(vertices), np.concatenate(faces)), ring, centres


@pytest.mark.parametrize("filter_sigma", [0.0, 0.5, 1.2], ids=["box", "sharp", "soft"])
@pytest.mark.parametrize("distortion", [(), BARREL], ids=["pinhole", "lens"])
def test_camera_rays_hit_points_at_their_projection(small, distortion, filter_sigma):
    camera = Camera.look_at(
        "c",
        64,
        48,
        (0.3, -0.9, 0.4),
        (0, 0, 0),
        50,
        roll_deg=20,
        distortion=distortion,
        filter_sigma=filter_sigma,
    )
    mesh, ring, centres = discs(camera, 2.0)
    share = coverage(build_scene(small.no_hair, mesh, hair=HAIR), camera, 400)["head"]
    row, column = np.mgrid[:48, :64]
    for centre in centres:
        # the lens bends a disc's middle away from the middle of its picture: compare the area
        rim, _ = camera.project(centre + ring)
        x, y = rim.T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        expected = [((a + np.roll(a, -1)) * cross).sum() / (3 * cross.sum()) for a in (x, y)]
        near = np.hypot(column - expected[0], row - expected[1]) < 8
        weight = share * near
        found = (weight * column).sum() / weight.sum(), (weight * row).sum() / weight.sum()
        np.testing.assert_allclose(found, expected, atol=0.02)
        assert weight.sum() == pytest.approx(abs(cross.sum()) / 2, rel=0.01)


def test_the_filter_is_the_gaussian_it_says(small):
    """The image of an edge is the integral of the filter."""
    edge = Mesh(
        np.array([[0, -1, -1], [1, -1, -1], [1, 1, 1], [0, 1, 1.0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    for sigma in (0.0, 0.4, 1.0):
        camera = Camera.look_at("c", 16, 8, (0, -1, 0), (0, 0, 0), 20, filter_sigma=sigma)
        share = coverage(build_scene(small.no_hair, edge, hair=HAIR), camera, 1024)["head"]
        offset = np.arange(16) - 7.5
        expected = ndtr(offset / sigma) if sigma else np.clip(offset + 0.5, 0, 1)
        np.testing.assert_allclose(share.mean(0), expected, atol=0.005)
