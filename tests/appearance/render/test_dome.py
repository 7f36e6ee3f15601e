"""Light projected on harmonics over the dome, beside the unbiased renderer."""

import numpy as np
import pytest

from appearance.render.coverage import coverage
from appearance.render.olat import render_olat
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import build_scene
from reconstruction.geometry.lights import Light, dome_positions

BLOND = HairAppearance((0.06, 0.1, 0.2), 0.35, 0.35)


def dome(count=12, radius=1.2):
    return [Light(f"l{i}", p, np.full(3, 8.0)) for i, p in enumerate(dome_positions(count, radius))]


@pytest.fixture(scope="module")
def blond(small):
    """A tuft before a camera, and the pixels that it covers."""
    scene, camera = build_scene(small.tuft(), None, hair=BLOND), small.camera()
    return scene, camera, np.flatnonzero(coverage(scene, camera)["hair"].ravel() > 0.5)


def test_bias_is_below_noise_and_the_error_below_the_unbiased_renderers(blond):
    scene, camera, pixels = blond

    def runs(count, spp, **options):
        images = [
            render_olat(scene, camera, dome(), spp=spp, pixels=pixels, seed=s, **options)
            for s in range(count)
        ]
        return np.array(images, float)

    truth = runs(4, 192)
    plain, smooth = runs(4, 12), runs(4, 12, degree=6)
    # products of independent differences are free of both sides' noise
    one, other = ((smooth[k : k + 2] - truth[k : k + 2]).mean(0) for k in (0, 2))
    bias = (one * other).mean()
    noise = smooth.var(0, ddof=1).mean()
    assert bias < noise
    assert bias + noise < 0.6 * plain.var(0, ddof=1).mean()
    assert smooth.mean() == pytest.approx(truth.mean(), rel=0.05)


def test_direct_light_is_the_unbiased_renderers(small):
    scene = build_scene(small.no_hair, small.plane(), hair=BLOND)
    lights = [x for x in dome() if x.position[2] > 0.1]
    plain, smooth = (
        render_olat(scene, small.camera(), lights, spp=4, max_depth=3, degree=degree, seed=2)
        for degree in (None, 3)
    )
    assert plain.max() > 0
    np.testing.assert_array_equal(plain, smooth)


def test_lights_at_different_distances_keep_their_share(blond):
    scene, camera, pixels = blond
    near = dome()
    far = [Light(x.name, 1.5 * x.position, 1.5**2 * x.intensity) for x in near[:6]] + near[6:]
    one, other = (
        render_olat(scene, camera, lights, spp=64, pixels=pixels, degree=4).mean((1, 2))
        for lights in (near, far)
    )
    np.testing.assert_allclose(one, other, rtol=0.12)


def test_lights_inside_the_subject_are_refused(small):
    scene = build_scene(small.tuft(), small.plane(), hair=BLOND)
    with pytest.raises(ValueError, match="render with degree=None"):
        render_olat(scene, small.camera(), dome(radius=0.4), spp=2, degree=2, max_depth=2)
    with pytest.raises(ValueError, match="degree must be"):
        render_olat(scene, small.camera(), dome(), spp=1, degree=2)
