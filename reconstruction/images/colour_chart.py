"""A chart of 24 colours and a matt ball in an image, found by OpenCV's detectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from skimage.measure import CircleModel, ransac

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.images.srgb import srgb

PUBLISHED = (
    *((115, 82, 68), (194, 150, 130), (98, 122, 157), (87, 108, 67), (133, 128, 177)),
    *((103, 189, 170), (214, 126, 44), (80, 91, 166), (193, 90, 99), (94, 60, 108)),
    *((157, 188, 64), (224, 163, 46), (56, 61, 150), (70, 148, 73), (175, 54, 60)),
    *((231, 199, 31), (187, 86, 149), (8, 133, 161), (243, 243, 242), (200, 200, 200)),
    *((160, 160, 160), (122, 122, 121), (85, 85, 85), (52, 52, 52)),
)
"""sRGB of the 24 patches, row by row (X-Rite, ColorChecker Classic, before November 2014)."""
GREYS = slice(18, 24)
FEWEST_GREYS = 3
OTHER_COLOURS = 0.3
"""Median difference of chromaticities, summed over channels, above which a grid is no chart."""
EXPOSURES = (99.5, 95.0, 99.95)
"""Percentiles that are white in the images that are searched."""
RIM_SEARCH = 0.1
"""Distance, in radii, of an outline's points from the detected circle."""
FEWEST_RAYS, RIM_ERROR = 60, 0.6
"""Least number of 180 rays whose edges lie on one circle, and their error in pixels: a ball that is
lit from one side shows part of its rim."""


@dataclass(frozen=True, eq=False)
class Chart:
    """`patches (24, 4, 2)` in pixels, and their mean linear `colours (24, 3)`.

    `white_balance (3,)` are factors on red, green and blue, green 1, that make the grey patches
    neutral, with the largest standard `error` of a factor.
    """

    patches: Array
    colours: Array
    white_balance: Array
    error: float


def find_chart(image: AnyFloats, saturated: Bools | None = None) -> Chart | None:
    """The chart in a linear `image (H, W, 3)`; None without one, or with under 3 usable greys.

    Brightness is compared inside of patches only, so shadows do not matter.
    """
    for white in EXPOSURES:
        boxes = _detected(_eight_bits(image, white))
        if boxes is not None and (chart := _measured(image, saturated, boxes)) is not None:
            return chart
    return None


def find_balls(image: AnyFloats) -> list[tuple[float, float, float]]:
    """x, y and radius in pixels of the round outlines in a linear `image (H, W, 3)`, best first.

    Detected by the gradients' directions (OpenCV, HOUGH_GRADIENT_ALT), then fitted to the steepest
    points along rays from the centre. Outlines inside another one are left out.
    """
    out: list[tuple[float, float, float]] = []
    for white in EXPOSURES[:2]:
        grey = cv2.cvtColor(_eight_bits(image, white), cv2.COLOR_BGR2GRAY)
        grey, side = cv2.GaussianBlur(grey, (0, 0), 1.0), min(grey.shape)
        found = cv2.HoughCircles(
            grey, cv2.HOUGH_GRADIENT_ALT, 1.5, side / 8,
            param1=200, param2=0.9, minRadius=max(6, side // 60), maxRadius=side // 3,
        )  # fmt: skip
        for x, y, radius in [] if found is None else found.reshape(-1, found.shape[-1])[:, :3]:
            circle = _fitted(grey.astype(np.float32), float(x), float(y), float(radius))
            if circle is None or any(np.hypot(circle[0] - a, circle[1] - b) < r for a, b, r in out):
                continue
            out.append(circle)
    return out


def _fitted(
    grey: AnyFloats, x: float, y: float, radius: float
) -> tuple[float, float, float] | None:
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    along = radius * np.arange(1 - RIM_SEARCH, 1 + RIM_SEARCH, 0.25 / radius)
    at_x, at_y = (c + np.outer(along, f(angle)) for c, f in ((x, np.cos), (y, np.sin)))
    whole = (at_x >= 0) & (at_x < grey.shape[1] - 1) & (at_y >= 0) & (at_y < grey.shape[0] - 1)
    profile = cv2.remap(grey, at_x.astype("f4"), at_y.astype("f4"), cv2.INTER_LINEAR)
    steps = np.abs(np.diff(profile, axis=0))
    best, ray = steps.argmax(axis=0), np.arange(len(angle))
    good = whole.all(axis=0) & (steps[best, ray] > 0.3 * np.median(steps[best, ray]))
    rim = along[best[good]] + 0.125
    points = np.stack([x + rim * np.cos(angle[good]), y + rim * np.sin(angle[good])], axis=1)
    if len(points) < FEWEST_RAYS:
        return None
    circle, kept = ransac(points, CircleModel, 3, RIM_ERROR, max_trials=300, rng=0)
    if circle is None or kept.sum() < FEWEST_RAYS:
        return None
    return float(circle.center[0]), float(circle.center[1]), float(circle.radius)


def _eight_bits(image: AnyFloats, white: float) -> Array:
    """BGR at the exposure at which the percentile `white` is white."""
    full = max(float(np.percentile(image.max(axis=-1), white)), 1e-12)
    return np.ascontiguousarray(np.round(255 * srgb(image[..., ::-1] / full)).astype(np.uint8))


def _detected(picture: Array) -> Array | None:
    detector: Any = cv2.mcc.CCheckerDetector.create()
    if hasattr(detector, "setColorChartType"):
        detector.setColorChartType(cv2.mcc.MCC24)
        found = detector.process(picture, 1)
    else:  # before OpenCV 5
        found = detector.process(picture, cv2.mcc.MCC24, 1)
    if not found:
        return None
    return np.asarray(detector.getBestColorChecker().getColorCharts(), float).reshape(24, 4, 2)


def _measured(image: AnyFloats, saturated: Bools | None, boxes: Array) -> Chart | None:
    colours, good = np.zeros((24, 3)), np.zeros(24, bool)
    for k, box in enumerate(boxes):
        inside = np.zeros(image.shape[:2], np.uint8)
        cv2.fillConvexPoly(inside, np.round(box).astype(np.int32), 1)
        values = image[inside > 0]
        if len(values) < 4:
            return None
        colours[k] = np.median(values, axis=0)
        blown = saturated is not None and saturated[inside > 0].mean() > 0.01
        noise = values.std(axis=0) / np.sqrt(len(values))
        good[k] = (colours[k] > 5 * noise).all() and not blown
    reference = _linear(np.array(PUBLISHED) / 255)
    greys = np.arange(24)[GREYS][good[GREYS]]
    if len(greys) < FEWEST_GREYS:
        return None
    factors = reference[greys] / colours[greys]
    factors /= factors[:, 1:2]
    balance = np.median(factors, axis=0)
    spread = 1.4826 * np.median(np.abs(factors / balance - 1), axis=0)
    mine, theirs = balance * colours[good], reference[good]
    shares = [c / c.sum(axis=1, keepdims=True) for c in (mine, theirs)]
    if np.median(np.abs(shares[0] - shares[1]).sum(axis=1)) > OTHER_COLOURS:
        return None
    error = float(spread.max() * np.sqrt(np.pi / 2 / len(greys)))
    return Chart(boxes, colours, balance, error)


def _linear(values: Array) -> Array:
    """Linear light of sRGB values in [0, 1]."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
