"""Silhouettes of the subject, and the noise of a camera's images."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.arrays import AnyFloats, Bools, Floats
from reconstruction.capture.exposures import averaged
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import Step
from reconstruction.images.grey import grey

NOISE_FACTOR = 5.0
FAINTEST = 0.004  # of the subject's 95th percentile: below it is stray light
DARKEST = 0.05  # of the 95th percentile: a mode above it is the subject
MOST_SATURATED = 0.02
MOST_LIGHTS = 32  # that are compared with a lit background
LIKE_BACKGROUND = 1.5  # times its radiance
AS_ONE = 0.9  # least cosine of the angle between a background's changes; hair has up to 0.86
SMALLEST = 6  # pixels: smaller specks are noise
NO_SINGLE_LIGHTS = "there are no single lights"


class NoSilhouette(ValueError):
    """A camera without frames for a silhouette."""


def dark_rgb(capture: Capture, camera: str, exposure: float | None = None) -> Floats:
    """Mean of the camera's dark frames `(H, W, 3)`, of those nearest to `exposure`; else zeros."""
    steps = capture.dark_steps(camera, exposure)
    c = capture.rig.camera(camera)
    if not steps:
        return np.zeros((c.height, c.width, 3), np.float32)
    return np.mean([capture.frame(s, camera) for s in steps], axis=0)


def dark_frame(capture: Capture, camera: str, exposure: float | None = None) -> Floats:
    """`dark_rgb`'s mean over the channels `(H, W)`."""
    return np.asarray(dark_rgb(capture, camera, exposure).mean(axis=-1))


def dark_response(capture: Capture, step: Step, camera: str) -> tuple[Floats, Bools]:
    """The frame minus the dark one at full level `(H, W, 3)`, and saturated pixels `(H, W)`."""
    image, saturated = capture.response_and_saturated(step, camera)
    dark = dark_rgb(capture, camera, step.exposure)
    return image - dark / np.float32(step.level or 1.0), saturated


def background_noise(image: AnyFloats) -> float:
    """Standard deviation of the unlit pixels of a dark-subtracted `image (...)`."""
    return background(image)[1]


def noise_of_frames(images: AnyFloats, most: int = 1 << 22) -> float:
    """Standard deviation of unlit pixels in dark-subtracted frames `(N, H, W)` of one camera.

    All frames are used together: if hair fills a lit frame, no pixel of it is unlit. About `most`
    pixels in evenly spaced rows are read.
    """
    rows = images.reshape(-1, images.shape[-1])
    return background_noise(rows[:: max(1, images.size // most)])


def background(image: AnyFloats) -> tuple[float, float]:
    """Level and standard deviation of the unlit pixels of a dark-subtracted `image (...)`.

    Noise is symmetric about zero and the subject only adds light, so negative values are the lower
    half of the noise. Without negative values black was clipped: the noise then lies around the
    half-sample mode (Robertson and Cryer 1974). Both are 0 for black without noise (adjacent zeros)
    and if the mode is too bright for an unlit background.
    """
    below = -image[image < 0]
    if below.size:
        return 0.0, 1.4826 * float(np.median(below))
    zero = image <= 0
    cut = zero.mean() > 0.01
    if cut and (zero[..., :-1] & ~zero[..., 1:]).sum() < 0.3 * zero[..., :-1].sum():
        return 0.0, 0.0  # adjacent zeros: black without noise
    values = np.sort(image[~zero], axis=None)
    level = _half_sample_mode(values)
    if not 0 < level < DARKEST * float(np.quantile(values, 0.95)):
        return 0.0, 0.0
    noise = 1.4826 * float(np.median(level - values[values <= level]))
    return level, max(noise, level) if cut else noise


def _half_sample_mode(values: AnyFloats) -> float:
    """Mode of sorted `values (N,)`: the densest half of the densest half, and so on."""
    while len(values) > 2:
        half = (len(values) + 1) // 2
        first = int(np.argmin(values[half - 1 :] - values[: len(values) - half + 1]))
        values = values[first : first + half]
    return float(np.mean(values)) if len(values) else 0.0


def lit_frame(capture: Capture, camera: str) -> tuple[Floats, Bools]:
    """`dark_response` of the camera's first fully lit frame, or the mean under its patterns; black
    and saturated without one."""
    steps = [s for s in capture.without_single_lights() if capture.has(s, camera)]
    if steps and steps[0].kind == "all_on":
        return dark_response(capture, steps[0], camera)
    if steps:
        return averaged((1.0, *dark_response(capture, s, camera)) for s in steps)
    c = capture.rig.camera(camera)
    return np.zeros((c.height, c.width, 3), np.float32), np.ones((c.height, c.width), bool)


def lit_image(capture: Capture, camera: str) -> Floats:
    """`lit_rgb`'s mean over the channels `(H, W)`."""
    return grey(lit_rgb(capture, camera))


def lit_rgb(capture: Capture, camera: str) -> Floats:
    """The subject under all lights minus the dark frame `(H, W, 3)`.

    The all-on frame at full level, else the sum of the OLAT frames or patterns, else the first
    tracking frame; frames with over `MOST_SATURATED` saturated lit pixels come last. Raises
    `NoSilhouette` without any of them.
    """
    blown: list[Step] = []
    for kind, first in (("all_on", True), ("olat", False), ("pattern", False), ("tracking", True)):
        steps = [s for s in capture.steps if s.kind == kind and capture.has(s, camera)]
        if first and steps and _blown(capture, camera, steps[0]):
            blown, steps = blown or steps[:1], []
        if steps:
            return _sum(capture, camera, steps[:1] if first else steps)
    if blown:
        return _sum(capture, camera, blown)
    raise NoSilhouette(f"{capture.path}: {camera} has no all_on, olat, pattern or tracking frame")


def _blown(capture: Capture, camera: str, step: Step) -> bool:
    image, saturated = capture.response_and_saturated(step, camera)
    lit = int((grey(image) > 0.1 * float(image.max(initial=0.0))).sum())
    return int(saturated.sum()) > MOST_SATURATED * max(lit, 1)


def silhouette(capture: Capture, camera: str) -> Bools:
    """Pixels `(H, W)` of the subject: the user's mask, else lit pixels without specks and pinholes.

    Raises `NoSilhouette` for a camera without lit frames.
    """
    if (given := capture.subject(camera)) is not None:
        return given
    if camera in capture.lenses:  # resampling would spread faint light by a pixel
        bent = silhouette(capture.view(undistorted=False), camera)
        return capture.lenses[camera].undistort_mask(bent)
    image = lit_image(capture, camera)
    positive = image[image > 0]
    bright = float(np.percentile(positive, 95)) if positive.size else 0.0
    level, noise = background(image)
    image, bright = image - np.float32(level), bright - level
    if bright <= NOISE_FACTOR * noise:
        return np.zeros(image.shape, bool)
    mask = image > max(NOISE_FACTOR * noise, FAINTEST * bright)
    mask = without_lit_background(capture, camera, mask)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    small = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] < SMALLEST]
    mask &= ~np.isin(labels, small)
    return np.asarray(_fill_pinholes(mask))


def without_lit_background(capture: Capture, camera: str, mask: Bools) -> Bools:
    """The silhouette `mask (H, W)` without a lit background, which lies at the image's edges.

    Unlike the subject, a background changes as one with the light: a pixel is part of it if its
    radiance under the single lights is at most `LIKE_BACKGROUND` times the median's at the edges
    outside of the user's hair mask, or in proportion to it up to twice that. What remains is
    connected to the hair. The mask is returned as it is if it covers under half of the edges, if
    they differ from each other in radiance or in how they change, as those of hair that fills an
    image do, or if nothing is much brighter.
    """
    edge, hair = edges(mask), capture.mask(camera)
    if hair is not None:
        edge &= ~hair
    steps = [s for s in capture.of_kind("olat") if capture.has(s, camera)]
    steps = steps[:: max(1, len(steps) // MOST_LIGHTS)]
    if len(steps) < 2 or 2 * int((mask & edge).sum()) <= int(edge.sum()):
        return mask
    # single pixels, and their neighbourhoods, in which noise changes less
    with_edge, square, total = *np.zeros((2, 2, *mask.shape)), 0.0
    for step in steps:
        image = grey(dark_response(capture, step, camera)[0]).astype(float)
        level = float(np.median(image[edge]))
        both = np.stack([image, cv2.blur(image, (3, 3))])
        with_edge += level * both
        square += both**2
        total += level**2
    ratio = np.sqrt(square[0] / max(total, 1e-300))
    alike, nearby = with_edge / np.maximum(np.sqrt(square * total), 1e-300)
    behind = (ratio < LIKE_BACKGROUND) | ((ratio < 2 * LIKE_BACKGROUND) & (alike > 0.97))
    if behind[edge].mean() < 0.5 or np.median(nearby[edge]) < AS_ONE:
        return mask
    if np.quantile(ratio, 0.98) < 2.5 * LIKE_BACKGROUND:
        return mask
    kept = mask & ~behind
    if hair is None:
        return kept
    labels, _ = ndimage.label(kept | hair, np.ones((3, 3)))
    return np.asarray(kept & np.isin(labels, np.unique(labels[hair])))


def edges(mask: Bools) -> Bools:
    """The outermost pixels of an image of the size of `mask (H, W)`."""
    out = np.ones(mask.shape, bool)
    out[1:-1, 1:-1] = False
    return out


def _fill_pinholes(mask: Bools) -> Bools:
    """Close holes of under `SMALLEST` pixels; larger ones may be gaps in the hair."""
    holes, count = ndimage.label(~mask)
    area = np.bincount(holes.ravel(), minlength=count + 1)
    return mask | ((area < SMALLEST)[holes] & ~mask)


def _sum(capture: Capture, camera: str, steps: list[Step]) -> Floats:
    dark: dict[float, Floats] = {}
    c = capture.rig.camera(camera)
    total = np.zeros((c.height, c.width, 3), np.float32)
    for step in steps:
        if step.exposure not in dark:
            dark[step.exposure] = dark_rgb(capture, camera, step.exposure)
        image = capture.frame(step, camera) - dark[step.exposure]
        total += image / (step.level if step.level > 0 else 1.0)
    return total
