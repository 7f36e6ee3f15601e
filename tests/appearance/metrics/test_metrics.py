"""Image metrics against scikit-image and against numbers worked by hand."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from appearance import Exposure, psnr, ssim
from appearance.metrics.pictures import small
from appearance.metrics.scores import relative_error, srgb, ssim_map


@pytest.fixture
def pair():
    rng = np.random.default_rng(1)
    truth = rng.uniform(size=(40, 48, 3))
    return np.clip(truth + 0.1 * rng.normal(size=truth.shape), 0, 1), truth


def test_ssim_agrees_with_scikit_image(pair):
    image, truth = pair
    _, full = structural_similarity(
        image,
        truth,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    # a window that crosses the border is where the two definitions part
    inside = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(ssim_map(image, truth)[inside], full[inside], atol=1e-12)


def test_ssim_on_a_mask_does_not_see_what_lies_beside_it(pair):
    image, truth = pair
    mask = np.zeros(truth.shape[:2], bool)
    mask[8:30, 10:33] = True
    value = ssim(image, truth, mask)
    other = np.where(mask[..., None], image, 0.7)
    assert ssim(other, truth, mask) == pytest.approx(value, abs=1e-12)
    assert ssim(truth, truth, mask) == pytest.approx(1.0, abs=1e-12)


def test_psnr_agrees_with_scikit_image(pair):
    image, truth = pair
    want = peak_signal_noise_ratio(truth, image, data_range=1.0)
    assert psnr(image, truth) == pytest.approx(want, abs=1e-9)
    assert psnr(truth, truth) == 100.0


def test_psnr_counts_only_the_mask():
    truth = np.zeros((4, 4, 3))
    image = truth.copy()
    image[0, 0] = 0.1
    mask = np.zeros((4, 4), bool)
    mask[0, :2] = True
    assert psnr(image, truth, mask) == pytest.approx(-10 * np.log10(0.01 / 2))


def test_relative_error_of_a_scaled_image_is_the_scale():
    truth = np.random.default_rng(0).uniform(size=(5, 5, 3))
    assert relative_error(1.2 * truth, truth) == pytest.approx(0.2)
    with pytest.raises(ValueError, match="black"):
        relative_error(truth, 0 * truth)


def test_exposure_takes_the_99th_percentile_to_white():
    pixels = [np.linspace(0, 2, 1001), np.linspace(0, 2, 1001)]
    exposure = Exposure.of(pixels)
    assert exposure.scale == pytest.approx(1 / 1.98)
    assert float(exposure(1.98)) == pytest.approx(1.0)
    assert float(exposure(99.0)) == pytest.approx(1.0)
    assert float(srgb(0.5)) == pytest.approx(0.735357, abs=1e-6)
    with pytest.raises(ValueError, match="lit"):
        Exposure.of([np.zeros(10)])


def test_shapes_and_masks_that_do_not_fit_are_refused(pair):
    image, truth = pair
    with pytest.raises(ValueError, match="alike"):
        psnr(image[:-1], truth)
    with pytest.raises(ValueError, match="mask"):
        ssim(image, truth, np.zeros(truth.shape[:2], bool))


def test_a_frame_in_a_comparison_is_as_small_as_it_is_shown():
    """4000 × 3000 pixels of three numbers were 290 MB a picture, of dozens."""
    ramp = np.broadcast_to(np.linspace(0, 1, 4000)[:, None, None], (4000, 3000, 3))
    shown = small(ramp)
    assert max(shown.shape) <= 640
    np.testing.assert_allclose(shown[:, 0, 0], np.linspace(0, 1, len(shown)), atol=2e-3)
