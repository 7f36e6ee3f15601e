"""Space-time analysis of a scanline sweep (Curless and Levoy 1995; Photobooth §3.1).

A sweep is streamed from disk. For every pixel the strongest temporal maxima are kept with the
frames around them, so that memory does not grow with the number of scanlines.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import Step
from reconstruction.geometry.projectors import Projector
from reconstruction.images.silhouettes import background_noise, dark_frame

REACH = 3  # frames kept before and after a maximum
WINDOW = 2 * REACH + 1
CLEAN = 0.1  # rows: error of a stripe's centre without noise, on fibres of many depths


NOISE_FACTOR, FAINTEST = 6.0, 0.01
"""Least height of a maximum, in deviations of the dark frame and as a share of the camera's bright
maxima (95th percentile, noise included)."""

DIRECT_SHARE = 0.15
"""Least share of the pixel's light over the sweep: indirect light comes from every row."""

CORRELATION = 0.9  # of a stripe with the projector's line profile
PER_PIXEL = 2  # maxima: a ray may hit several fibres


@dataclass(frozen=True, eq=False)
class Peaks:
    """Stripes of one projector in one camera, one entry for each.

    pixel (N, 2) int (x, y); row (N,) fractional row; deviation (N,) of the row, rows; brightness
    (N,) of the maximum; step (N,) `Step.index` of its frame; saturated (N,) whether a frame at the
    maximum was at full scale. Of all frames' `bright` pixels, `side_responses` are at no maximum.
    """

    camera: str
    projector: str
    pixel: Ints
    row: Array
    deviation: Array
    brightness: Array
    step: Ints
    saturated: Bools
    candidates: int = 0
    bright: int = 0
    side_responses: int = 0
    missing_rows: tuple[int, ...] = field(default=())


def find_peaks(capture: Capture, camera: str, projector: str) -> Peaks:
    """Read one camera's frames of one projector's sweep in row order and locate its stripes.

    Maxima next to a missing frame are ignored. `KeyError` for unknown names.
    """
    device = capture.rig.projector(projector)
    capture.rig.camera(camera)
    sweep = {s.row: s for s in capture.of_kind("scanline") if s.projector == projector}
    scan = Scan(capture, camera, sweep, device.height, PER_PIXEL)
    for row in range(-REACH, device.height + REACH):
        scan.push(row)
    noise = scan.noise()
    maxima = scan.value[0] if scan.least else scan.value[0][scan.value[0] > 0]
    bright = float(np.percentile(maxima, 95)) if maxima.size else 0.0
    floor = max(NOISE_FACTOR * noise, FAINTEST * bright, scan.least)
    strong = scan.value > floor
    layer, y, x = np.nonzero(strong)
    window = scan.window[layer, y, x].astype(np.float64)
    value, at = scan.value[strong].astype(np.float64), scan.at[strong]
    offset, deviation, correlation, amplitude = fit_stripes(window, device, noise)
    share = amplitude / np.maximum(np.maximum(scan.total[y, x], value), amplitude)
    saturated = scan.clipped[strong]
    deviation[saturated] = np.maximum(deviation[saturated], 0.3)
    keep = ((share >= DIRECT_SHARE) & (correlation >= CORRELATION)) | saturated
    steps = np.array([sweep[r].index if r in sweep else -1 for r in range(device.height)])
    return Peaks(
        camera,
        projector,
        np.stack([x, y], axis=1)[keep],
        (at + offset)[keep],
        deviation[keep],
        value[keep],
        steps[at[keep]] if keep.any() else np.zeros(0, np.int64),
        saturated[keep],
        candidates=len(value),
        bright=scan.bright.above(floor),
        side_responses=scan.bright.above(floor) - scan.maxima.above(floor),
        missing_rows=tuple(scan.missing),
    )


def fit_stripes(window: Array, projector: Projector, noise: float) -> tuple[Array, ...]:
    """Fit the projector's line profile on a constant to `window (N, 7)` about each maximum.

    Least squares over centre (grid, then a parabola), extra width (depths mixed in one pixel),
    height and constant. Returns the centre `(N,)` relative to the middle frame in rows, its
    standard deviation `(N,)`, the correlation of window and profile `(N,)` in [0, 1], and the
    stripe's light `(N,)` summed over rows.
    """
    centres = np.linspace(-1.25, 1.25, 51)
    n = len(window)
    best = np.full(n, -np.inf)
    centre, extra, gradient, light = (np.zeros(n) for _ in range(4))
    flat = window - window.mean(axis=1, keepdims=True)
    energy = np.maximum(np.linalg.norm(flat, axis=1), np.finfo(float).tiny)
    for width in (0.0, 0.5, 0.9, 1.4):
        profile = _profiles(projector, centres, width)
        centred = profile - profile.mean(axis=1, keepdims=True)
        length = np.linalg.norm(centred, axis=1)
        score = flat @ (centred / length[:, None]).T / energy[:, None]
        i = np.clip(score.argmax(axis=1), 1, len(centres) - 2)
        left, mid, right = (score[np.arange(n), i + k] for k in (-1, 0, 1))
        bend = left - 2 * mid + right
        shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, 1.0), 0.0)
        better = mid > best
        best = np.where(better, mid, best)
        step = centres[1] - centres[0]
        centre = np.where(better, centres[i] + np.clip(shift, -1, 1) * step, centre)
        extra = np.where(better, width, extra)
        height = mid * energy / length[i]
        light = np.where(better, height, light)
        by_centre = np.linalg.norm(np.gradient(profile, centres, axis=0), axis=1)
        gradient = np.where(better, height * by_centre[i], gradient)
    # residuals above the noise are errors of the profile
    misfit = energy * np.sqrt(np.maximum(1 - best**2, 0) / (WINDOW - 3))
    error = np.maximum(noise, 0.5 * misfit)
    random = np.where(gradient > error, error / np.where(gradient > 0, gradient, 1.0), 1.0)
    deviation = np.sqrt(random**2 + (0.25 * extra) ** 2 + CLEAN**2)
    return centre, np.minimum(deviation, 1.0), np.clip(best, 0, 1), np.maximum(light, 0)


def _profiles(projector: Projector, centres: Array, width: float) -> Array:
    """Line profiles `(C, 7)` at the window's rows, spread by a Gaussian of `width` rows."""
    rows = np.arange(-REACH, REACH + 1)
    nodes, weights = np.polynomial.hermite_e.hermegauss(9 if width > 0 else 1)
    weights = weights / weights.sum()
    v = centres[:, None, None] + width * nodes
    return np.asarray((projector.row_weight(rows[None, :, None], v) * weights).sum(axis=-1))


class _Tally:
    """Counts values above a floor that is known only afterwards, to a hundredth."""

    def __init__(self) -> None:
        self._counts = np.zeros(1 << 15, np.int64)

    def add(self, values: Floats) -> None:
        """Count positive values."""
        # the upper half of a positive float32: the exponent and seven bits
        self._counts += np.bincount(values.view(np.uint32) >> 16, minlength=len(self._counts))

    def above(self, floor: float) -> int:
        return int(self._counts[(np.array(floor, np.float32).view(np.uint32) >> 16) + 1 :].sum())


class Scan:
    """The running state of one sweep: a ring of frames and each pixel's strongest maxima.

    Pixels under `least` are no maxima: half of the floor by the least noise of the frames so far.
    """

    def __init__(
        self, capture: Capture, camera: str, sweep: dict[int | None, Step], rows: int, layers: int
    ) -> None:
        c = capture.rig.camera(camera)
        shape = (c.height, c.width)
        self.capture, self.camera, self.sweep, self.rows = capture, camera, sweep, rows
        self.ring: deque[Floats] = deque(maxlen=WINDOW)
        self.clip: deque[Bools] = deque(maxlen=WINDOW)
        self.held: deque[bool] = deque(maxlen=WINDOW)
        self.value = np.zeros((layers, *shape), np.float32)
        self.at = np.zeros((layers, *shape), np.int64)
        self.window = np.zeros((layers, *shape, WINDOW), np.float32)
        self.clipped = np.zeros((layers, *shape), bool)
        self.total = np.zeros(shape, np.float32)
        self.bright, self.maxima = _Tally(), _Tally()
        self.missing: list[int] = []
        self.least = 0.0
        self._noises: list[float] = []
        self._dark: dict[float, Floats] = {}

    def noise(self) -> float:
        """Median over frames of the unlit pixels' deviation, in units of the response."""
        return float(np.median(self._noises)) if self._noises else 0.0

    def push(self, row: int) -> None:
        """Read the frame of `row` (dark beyond the projector's edge) and process a maximum there
        may be `REACH` rows before."""
        shape = self.total.shape
        image, clipped, held = np.zeros(shape, np.float32), np.zeros(shape, bool), True
        if 0 <= row < self.rows:
            step = self.sweep.get(row)
            held = step is not None and self.capture.has(step, self.camera)
            if step is None or not held:
                self.missing.append(row)
            else:
                image, clipped = self._read(step)
                self.total += image
                self.bright.add(image[image > self.least])
        self.ring.append(image.ravel())
        self.clip.append(clipped.ravel())
        self.held.append(held)
        middle = row - REACH
        if len(self.ring) == WINDOW and all(list(self.held)[REACH - 1 : REACH + 2]):
            self._insert(middle)

    def _read(self, step: Step) -> tuple[Floats, Bools]:
        if step.exposure not in self._dark:
            self._dark[step.exposure] = dark_frame(self.capture, self.camera, step.exposure)
        response, saturated = self.capture.response_and_saturated(step, self.camera)
        dark = self._dark[step.exposure] / np.float32(step.level if step.level > 0 else 1.0)
        image = response @ np.full(3, 1 / 3, np.float32) - dark
        if step.row is not None and step.row % 8 == 0:
            self._noises.append(background_noise(image))
            self.least = 0.5 * NOISE_FACTOR * min(self._noises)
        return image, saturated

    def _insert(self, middle: int) -> None:
        """Keep the middle frame's maxima where they exceed the weakest of the pixel."""
        before, now, after = (self.ring[REACH + k] for k in (-1, 0, 1))
        lit = np.flatnonzero(now > self.least)
        value = now[lit]
        highest = (value > before[lit]) & (value >= after[lit])
        pixel, value = lit[highest], value[highest]
        self.maxima.add(value)
        pixel = pixel[value > self.value[-1].ravel()[pixel]]
        for layer in range(len(self.value)):
            better = now[pixel] > self.value[layer].ravel()[pixel]
            which, pixel = pixel[better], pixel[~better]
            if not len(which):
                continue
            for store in (self.value, self.at, self.clipped, self.window):
                flat = store.reshape(len(store), self.value[0].size, *store.shape[3:])
                flat[layer + 1 :, which] = flat[layer:-1, which]
            near = self.clip[REACH - 1] | self.clip[REACH] | self.clip[REACH + 1]
            self.value[layer].ravel()[which] = now[which]
            self.at[layer].ravel()[which] = middle
            self.clipped[layer].ravel()[which] = near[which]
            window = np.stack([f[which] for f in self.ring], axis=1)
            self.window[layer].reshape(-1, WINDOW)[which] = window
