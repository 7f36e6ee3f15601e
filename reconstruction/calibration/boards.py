"""ChArUco boards: a chessboard with a marker in each white square."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reconstruction.arrays import Array, Bools, Ints

PER_SQUARE = 64  # pixels per square of the rendered print


class CalibrationError(ValueError):
    """Captures that do not determine the calibration; says which, why, and what to capture."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Corners detected in an image: `ids (N,)` and `pixels (N, 2)`."""

    ids: Ints
    pixels: Array

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Board:
    """`columns` × `rows` squares of edge `square` with markers of edge `marker`, metres.

    The board's frame: origin at the print's top left corner, x right, y down, z away from the
    viewer. `dictionary` is OpenCV's name. The pattern is that of OpenCV 4.6 and later.
    """

    columns: int = 9
    rows: int = 7
    square: float = 0.027
    marker: float = 0.021
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        if not (self.dictionary.startswith("DICT_") and hasattr(cv2.aruco, self.dictionary)):
            raise CalibrationError(
                f"board: OpenCV has no dictionary {self.dictionary!r}; expected, for example, "
                "'DICT_4X4_50'"
            )
        sizes = 1e-6 <= self.square <= 1e3 and 0.1 * self.square <= self.marker < self.square
        if min(self.columns, self.rows) < 3 or not sizes:
            raise CalibrationError(
                "board: expected 3 × 3 squares or more, of 1e-6 to 1e3 m, markers smaller than "
                f"squares and a tenth of them at least, got {self.columns} × {self.rows}, squares "
                f"{self.square} m, markers {self.marker} m"
            )
        most, need = len(self._dictionary.bytesList), self.columns * self.rows // 2
        if need > most:
            raise CalibrationError(
                f"board: {self.columns} × {self.rows} squares need {need} markers, "
                f"{self.dictionary} has {most}"
            )

    @cached_property
    def corners(self) -> Array:
        """The inner chessboard corners `(N, 3)` in the board's frame, by number."""
        return np.asarray(self._opencv.getChessboardCorners(), np.float64)

    @property
    def size(self) -> Array:
        """Width and height `(2,)`, metres."""
        return self.square * np.array([self.columns, self.rows])

    def picture(self, per_square: int = PER_SQUARE) -> NDArray[np.uint8]:
        """The image to print `(H, W)`: ink 0, paper 255; `per_square` pixels per square."""
        size = (self.columns * per_square, self.rows * per_square)
        return np.asarray(self._opencv.generateImage(size))

    def ink(self, points: ArrayLike) -> Bools:
        """Whether board points `(..., 2)` are inked; outside the print they are not."""
        return self._look_up(self.picture() < 128, points, 0)

    def plain(self, points: ArrayLike, margin: float) -> Bools:
        """Whether board points `(..., 2)` are at least `margin` metres inside one colour."""
        ink = (self.picture() < 128).astype(np.uint8)
        reach = int(np.ceil(margin * PER_SQUARE / self.square))
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        return self._look_up(cv2.dilate(ink, kernel) == cv2.erode(ink, kernel), points, reach)

    def _look_up(self, picture: Bools, points: ArrayLike, border: int) -> Bools:
        """`picture (H, W)` at board points `(..., 2)`; false within `border` pixels of its edge."""
        at = np.floor(np.asarray(points, float) * (PER_SQUARE / self.square)).astype(int)
        end = np.array(picture.shape[::-1]) - border
        inside = np.asarray(((at >= border) & (at < end)).all(axis=-1))
        at = np.where(inside[..., None], at, 0)
        return np.asarray(inside & picture[at[..., 1], at[..., 0]])

    def find(self, image: ArrayLike) -> Sighting:
        """The corners detected in a linear grey `image (H, W)`, none without a board."""
        grey = np.asarray(image, np.float64)
        none = Sighting(np.zeros(0, np.int64), np.zeros((0, 2)))
        white = float(np.percentile(grey, 99.5))
        if not white > 0:
            return none
        # a square root amplifies the dark squares' noise less than a display gamma
        eight = np.rint(255 * np.sqrt(np.clip(grey / white, 0, 1))).astype(np.uint8)
        corners, ids, _, _ = self._detector.detectBoard(eight)
        if ids is None or not len(ids):
            return none
        ids, corners = np.asarray(ids, np.int64).ravel(), np.asarray(corners, np.float64)
        rough = Sighting(ids, corners.reshape(-1, 2))
        return self._refined(grey / white, rough) if len(rough) >= 6 else rough

    def _refined(self, image: Array, rough: Sighting) -> Sighting:
        """Corners refined by aligning the print with the image around them (Lucas, Kanade 1981).

        Unlike the detector's window, the patch includes the markers. A homography maps the print,
        each corner's shift accounts for distortion. Corners whose patch does not correlate with the
        print are removed.
        """
        flat = self.corners[rough.ids][:, :2]
        H, _ = cv2.findHomography(flat, rough.pixels, cv2.RANSAC, 2.0)
        if H is None or not np.linalg.det(H) > 0:
            return Sighting(rough.ids[:0], rough.pixels[:0])
        predicted = _mapped(H, flat)
        scale = np.sqrt(abs(np.linalg.det(H[:2, :2] - np.outer(predicted.mean(axis=0), H[2, :2]))))
        scale /= abs(H[2] @ (*flat.mean(axis=0), 1))
        reach = int(np.clip(round(0.45 * self.square * scale), 3, 14))
        side = np.arange(-reach, reach + 1)
        patch = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        sub = (np.arange(4) + 0.5) / 4 - 0.5
        sub = np.stack(np.meshgrid(sub, sub), axis=-1).reshape(-1, 2)
        at = rough.pixels.copy()
        back, n = np.linalg.inv(H), 2 * reach + 1
        for _ in range(3):
            near = np.rint(at).astype(int)
            pixels = near[:, None] + patch
            inside = np.asarray(((pixels >= 0) & (pixels < image.shape[::-1])).all(axis=-1))
            x, y = np.where(inside[..., None], pixels, 0).transpose(2, 0, 1)
            shown = image[y, x]
            moved = pixels[:, :, None] + sub - (at - predicted)[:, None, None]
            model = 1.0 - self.ink(_mapped(back, moved)).mean(axis=-1)
            gy, gx = np.gradient(model.reshape(-1, n, n), axis=(1, 2))
            columns = [model, np.ones_like(model), gx.reshape(model.shape), gy.reshape(model.shape)]
            A = np.stack(columns, axis=-1) * inside[..., None]
            normal = np.einsum("nki,nkj->nij", A, A) + 1e-9 * np.eye(4)
            fit = np.linalg.solve(normal, np.einsum("nki,nk->ni", A, shown * inside)[..., None])
            contrast = np.maximum(fit[:, 0, 0], 1e-6)[:, None]
            at = at - np.clip(fit[:, 2:, 0] / contrast, -1, 1)
        residual = (A @ fit)[..., 0] - shown * inside
        mean = (shown * inside).sum(axis=1, keepdims=True) / inside.sum(axis=1, keepdims=True)
        spread = (((shown - mean) * inside) ** 2).sum(axis=1)
        good = (residual**2).sum(axis=1) < 0.15 * spread
        good &= np.linalg.norm(at - rough.pixels, axis=1) < 1.5
        return Sighting(rough.ids[good], at[good])

    @property
    def _dictionary(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    @cached_property
    def _opencv(self) -> Any:
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square, self.marker, self._dictionary)

    @cached_property
    def _detector(self) -> Any:
        markers = cv2.aruco.DetectorParameters()
        markers.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        others = cv2.aruco.CharucoParameters(), markers, cv2.aruco.RefineParameters()
        return cv2.aruco.CharucoDetector(self._opencv, *others)


def _mapped(H: Array, points: Array) -> Array:
    """Points `(..., 2)` through a homography."""
    out = points @ H[:, :2].T + H[:, 2]
    return np.asarray(out[..., :2] / out[..., 2:])
