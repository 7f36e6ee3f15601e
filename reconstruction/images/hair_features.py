"""What tells hair from skin without geometry: how pixels answer lights, and how fine lines are.

A matte surface answers half of the lights by `albedo n·l`; fibres mirror a few lights and hide from
the others. Skin is smooth at the width of a few pixels; fibres are lines there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.capture.folder import Capture
from reconstruction.images.orientation import responses, texture
from reconstruction.reconstruct_options import LogGaborBank

MATTE_CONTRAST = 1.29  # sqrt(1/6 - 1/16) / (1/4): cosine over all directions, deviation over mean

FAINTEST_LINES = float(np.log(0.025))
"""`line_strength` that hair surpasses: rendered hair in focus has 0.047, skin 0.009 to 0.02."""

_BANK = LogGaborBank(wavelength=3.0, count=16, spread=1.0)
_ONE_CLASS = 3.0
"""Deviations between classes' means under which they are one: 2.65 for a Gaussian cut in two."""


def light_contrast(capture: Capture, camera: str, subject: Bools, lights: int = 96) -> Array | None:
    """How unlike a matte surface each pixel answers single lights: log ratio `(H, W)`, 0 for matte.

    The deviation over the mean of the answers to a dome of lights is 1.29 for a matte surface in
    the open, up to 2 with half of the lights in its own shadow; fibres mirror few: 2 to 7.
    Smoothed over 3×3 pixels. None where under eight lights were shot.
    """
    names = [n for n in capture.olat_lights() if capture.has_light(n, camera)]
    if len(names) < 8:
        return None
    names = names[:: max(1, len(names) // lights)]
    intensities = [capture.rig.light(n).intensity_towards(np.zeros(3)) for n in names]
    power = np.array([max(intensity.mean(), 1e-12) for intensity in intensities])
    values = capture.olat(camera, names).mean(axis=-1) / power[:, None, None]
    mean = np.maximum(values.mean(axis=0), 0)
    ratio = np.divide(values.std(axis=0), mean, out=np.ones_like(mean), where=mean > 0)
    logs = np.where(subject, np.log(np.maximum(ratio, 0.1) / MATTE_CONTRAST), 0.0)
    near = ndimage.uniform_filter(subject.astype(np.float64), 3)
    smooth = ndimage.uniform_filter(logs, 3) / np.where(near > 0, near, 1.0)
    return np.asarray(np.where(subject, smooth, 0.0))


def line_strength(lit: AnyFloats, subject: Bools) -> Array:
    """How strongly oriented filters answer the relative detail of a `lit (H, W)` picture: log.

    The log-Gabor bank's mean answer at a wavelength of three pixels, averaged in the subject by a
    Gaussian of three pixels; 0 outside.
    """
    answers = responses(_BANK, texture(lit, subject, 5.0)).mean(axis=0).astype(np.float64)
    near = ndimage.gaussian_filter(subject.astype(np.float64), 3.0)
    mean = ndimage.gaussian_filter(np.where(subject, answers, 0.0), 3.0) / np.maximum(near, 1e-6)
    return np.asarray(np.where(subject, np.log(np.maximum(mean, 1e-4)), 0.0))


def tell_apart(
    features: Mapping[str, Array], subjects: Mapping[str, Bools]
) -> dict[str, Array] | None:
    """Scores `(H, W)` by camera, above 0 for hair, from its `features (F, H, W)`, larger for hair.

    The pixels of all cameras are split together, since one that faces the back of a head shows hair
    alone: first by the feature that splits best, then twice along Fisher's discriminant, each time
    at Otsu's threshold. No feature counts negatively. None where there are not two classes.
    """
    pixels = np.concatenate([f[:, subjects[name]].T for name, f in features.items()])
    if len(pixels) < 2:
        return None
    middle = np.median(pixels, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(pixels - middle), axis=0), 1e-6)
    pixels = (pixels - middle) / spread
    alone = [otsu(column)[1] for column in pixels.T]
    direction = np.eye(len(alone))[int(np.argmax(alone))]
    for _ in range(3):
        along = pixels @ direction
        level, separation = otsu(along)
        if separation < _ONE_CLASS:
            return None
        classes = [pixels[along > level], pixels[along <= level]]
        apart = classes[0].mean(axis=0) - classes[1].mean(axis=0)
        within = sum(len(c) * np.atleast_2d(np.cov(c.T, bias=True)) for c in classes) / len(pixels)
        within += 0.1 * np.diag(np.diag(within)) + 1e-9 * np.eye(len(apart))
        used = direction
        direction = np.maximum(np.linalg.solve(within, apart), 0)
        direction /= max(float(np.linalg.norm(direction)), 1e-12)
    scale, offset = used / spread, used @ (middle / spread) + level
    return {
        name: np.where(subjects[name], np.tensordot(scale, f, 1) - offset, 0.0)
        for name, f in features.items()
    }


def otsu(values: Array) -> tuple[float, float]:
    """The threshold that splits `values (N,)` into the two tightest classes (Otsu 1979).

    Also how many of their common deviations the classes' means are apart. Infinite and 0 where
    there are not two values.
    """
    order = np.sort(values)
    n = len(order)
    total = np.cumsum(order)
    variance = float(np.var(order)) if n else 0.0
    if n < 2 or variance <= 0:
        return np.inf, 0.0
    k = np.arange(1, n)
    low, high = total[:-1] / k, (total[-1] - total[:-1]) / (n - k)
    between = k * (n - k) * (high - low) ** 2
    best = int(np.argmax(between))
    within = max(variance - float(between[best]) / n**2, 1e-12 * variance)
    return float(order[best]), float((high[best] - low[best]) / np.sqrt(within))
