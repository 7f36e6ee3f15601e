"""Cameras from one board in many poses: each lens alone, then all together.

Zhang's method (2000) initialises every camera, shared board poses connect them, and a bundle
adjustment solves for all lenses, cameras and board poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from reconstruction.arrays import Array, Ints
from reconstruction.calibration.boards import Board, CalibrationError, Sighting
from reconstruction.calibration.least_squares import Solution, minimise, numeric
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.rigid_motion import Rigid, align_devices

Sightings = Mapping[str, Mapping[str, Sighting]]

LEAST = 8  # corners in an image
CORNER = 0.05  # pixels: standard deviation of a corner
LOOSE = 0.02  # largest relative standard deviation of the focal length
LENSES = ((), (0,), (0, 1), (0, 1, 2, 3))
"""Sets of distortion coefficients (k1, k2, p1, p2) to choose from; k3 needs wider lenses."""


@dataclass(frozen=True, eq=False)
class CameraSolution:
    """Calibrated `cameras`, and the board's poses `board_to_world` by capture.

    By camera: `rms` of reprojection in pixels, `observations` (captures, corners), relative
    `focal_deviation`, `position_deviation` in metres against the first camera, and `residuals`
    (N, 2) in pixels.
    """

    cameras: tuple[Camera, ...]
    board_to_world: dict[str, Rigid]
    rms: dict[str, float]
    observations: dict[str, tuple[int, int]]
    focal_deviation: dict[str, float]
    position_deviation: dict[str, float]
    residuals: dict[str, Array]


def calibrate_cameras(
    nominal: Sequence[Camera], board: Board, sightings: Sightings, *, keep_lens: bool = False
) -> CameraSolution:
    """Calibrate the cameras of `nominal` from `sightings[camera][capture]`.

    `nominal` gives image sizes and, by the best rigid alignment, the world frame; with `keep_lens`
    also K and distortion, and one board pose suffices. Lengths are the board's.

    Raises `CalibrationError` if a camera has no view of the board, the board poses do not determine
    its lens, or no pose connects cameras.
    """
    usable = {c.name: _usable(c, board, sightings.get(c.name, {}), keep_lens) for c in nominal}
    if keep_lens:
        usable = {c.name: {p: _upright(c, s) for p, s in usable[c.name].items()} for c in nominal}
    alone = [_Lens.kept(c) if keep_lens else _one_lens(c, board, usable[c.name]) for c in nominal]
    bundle = _Bundle(board, [c.name for c in nominal], usable, alone)
    solution = minimise(bundle, bundle.start(_chain(board, usable, alone)), huber=3.0)
    return _result(bundle, solution, nominal)


def _usable(
    camera: Camera, board: Board, sightings: Mapping[str, Sighting], keep_lens: bool
) -> dict[str, Sighting]:
    out = {
        pose: s
        for pose, s in sightings.items()
        if len(s) >= LEAST
        and not board._opencv.checkCharucoCornersCollinear(s.ids.astype(np.int32)[:, None])
    }
    need = 1 if keep_lens else 3
    if len(out) < need:
        raise CalibrationError(
            f"{camera.name}: {LEAST} or more corners of the board are visible in {len(out)} "
            f"captures, expected {need}"
            + (" at different tilts" if need > 1 else "")
            + ": capture the board closer to it, or check the board's dimensions"
        )
    return out


def _upright(camera: Camera, sighting: Sighting) -> Sighting:
    """Pixels of a camera without skew, which OpenCV does not model."""
    _, skew, _, _, fy, cy = camera.K[:2].ravel()
    return replace(
        sighting, pixels=sighting.pixels - np.outer((sighting.pixels[:, 1] - cy) / fy, (skew, 0))
    )


@dataclass(frozen=True, eq=False)
class _Lens:
    """fx, fy, cx, cy, k1, k2, p1, p2, k3 `(9,)`, indices of the free ones, and a fixed skew."""

    values: Array
    free: Ints
    skew: float = 0.0

    @classmethod
    def kept(cls, camera: Camera) -> _Lens:
        K = camera.K
        values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera.distortion])
        return cls(values, np.zeros(0, np.int64), float(K[0, 1]))

    def matrix(self) -> Array:
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _one_lens(camera: Camera, board: Board, sightings: Mapping[str, Sighting]) -> _Lens:
    """The lens with the number of coefficients of the best Bayesian information criterion."""
    corners = [board.corners[s.ids].astype(np.float32) for s in sightings.values()]
    pixels = [s.pixels.astype(np.float32) for s in sightings.values()]
    count = 2 * sum(len(p) for p in pixels)
    best: tuple[float, _Lens] | None = None
    for lens in LENSES:
        fixed = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_LU
        fixed |= 0 if 0 in lens else cv2.CALIB_FIX_K1
        fixed |= 0 if 1 in lens else cv2.CALIB_FIX_K2
        fixed |= 0 if 2 in lens else cv2.CALIB_ZERO_TANGENT_DIST
        try:
            rms, K, bent, _, _ = cv2.calibrateCamera(
                corners, pixels, (camera.width, camera.height), None, None, flags=fixed
            )
        except cv2.error:
            continue  # undetermined by these poses
        if not (np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > 0):
            continue
        score = count * np.log(max(rms, 0.2 * CORNER) ** 2) + len(lens) * np.log(count)
        if best is None or score < best[0]:
            values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], bent.ravel()[:5]])
            best = score, _Lens(values, np.array([0, 1, 2, 3, *(4 + k for k in lens)]))
    if best is None:
        raise _open_lens(camera.name, len(sightings), np.inf)
    return best[1]


def _open_lens(name: str, poses: int, deviation: float) -> CalibrationError:
    known = f"known to {deviation:.1%} (limit {LOOSE:.0%})" if deviation < 1 else "not determined"
    return CalibrationError(
        f"{name}: {poses} poses of the board do not determine the lens, its focal length is "
        f"{known}: tilt the board by 30° or more in several directions, or keep the nominal lens"
    )


def _pose(lens: _Lens, board: Board, sighting: Sighting) -> Rigid | None:
    """Board to camera; None if no pose reproduces the corners."""
    data = board.corners[sighting.ids], sighting.pixels, lens.matrix(), lens.values[4:]
    found, turn, shift = cv2.solvePnP(*data, flags=cv2.SOLVEPNP_IPPE)
    if found:
        found, turn, shift = cv2.solvePnP(*data, turn, shift, useExtrinsicGuess=True)
    if not (found and np.isfinite([turn, shift]).all()):
        return None
    return Rigid(cv2.Rodrigues(turn)[0], shift.ravel())


def _chain(
    board: Board, usable: Mapping[str, Mapping[str, Sighting]], lenses: Sequence[_Lens]
) -> tuple[dict[str, Rigid], dict[str, Rigid]]:
    """World-to-camera and board-to-world poses in the first camera's frame.

    By a spanning tree over the sightings, most corners first (Prim).
    """
    edges = {}
    for (name, seen), lens in zip(usable.items(), lenses, strict=True):
        for pose, s in seen.items():
            if (edge := _pose(lens, board, s)) is None:
                raise _open_lens(name, len(seen), np.inf)
            edges[name, pose] = edge
    first = next(iter(usable))
    cameras, boards = {first: Rigid.identity()}, dict[str, Rigid]()
    while True:
        ready = [e for e in edges if (e[0] in cameras) != (e[1] in boards)]
        if not ready:
            break
        name, pose = max(ready, key=lambda e: len(usable[e[0]][e[1]]))
        if name in cameras:
            boards[pose] = cameras[name].inverse() @ edges[name, pose]
        else:
            cameras[name] = edges[name, pose] @ boards[pose].inverse()
    if apart := sorted(set(usable) - set(cameras)):
        raise CalibrationError(
            f"no capture of the board connects {apart} to {sorted(cameras)}: capture poses visible "
            "to a camera of each group"
        )
    return cameras, boards


class _Bundle:
    """Residuals of all corners and derivatives by lenses, cameras but the first, and boards."""

    def __init__(
        self,
        board: Board,
        names: Sequence[str],
        usable: Mapping[str, Mapping[str, Sighting]],
        lenses: Sequence[_Lens],
    ) -> None:
        self.board, self.names, self.usable, self.lenses = board, list(names), usable, lenses
        self.poses = sorted({p for seen in usable.values() for p in seen})
        ends = np.cumsum([0] + [len(lens.free) for lens in lenses])
        self.lens_at = [np.arange(a, b) for a, b in pairwise(ends)]
        self.cameras_from = int(ends[-1]) - 6  # the first camera is fixed
        self.boards_from = self.cameras_from + 6 * len(self.names)
        self.size = self.boards_from + 6 * len(self.poses)
        self.count = 2 * sum(len(s) for seen in usable.values() for s in seen.values())

    def start(self, poses: tuple[dict[str, Rigid], dict[str, Rigid]]) -> Array:
        """Parameters from lenses and poses."""
        cameras, boards = poses
        x = np.zeros(self.size)
        for lens, at in zip(self.lenses, self.lens_at, strict=True):
            x[at] = lens.values[lens.free]
        for k, name in enumerate(self.names[1:], 1):
            x[self.camera_at(k)] = cameras[name].vector()
        for k, pose in enumerate(self.poses):
            x[self.board_at(k)] = boards[pose].vector()
        return x

    def camera_at(self, k: int) -> Ints:
        """Parameter indices of the pose of camera `k` > 0."""
        return np.arange(6) + self.cameras_from + 6 * k

    def board_at(self, k: int) -> Ints:
        """Parameter indices of the pose of board `k`."""
        return np.arange(6) + self.boards_from + 6 * k

    def lens(self, x: Array, k: int) -> _Lens:
        """The lens of camera `k` at the parameters `x`."""
        values = self.lenses[k].values.copy()
        values[self.lenses[k].free] = x[self.lens_at[k]]
        return replace(self.lenses[k], values=values)

    def camera_pose(self, x: Array, k: int) -> Rigid:
        """World to camera `k`."""
        return Rigid.identity() if k == 0 else Rigid.from_vector(x[self.camera_at(k)])

    def __call__(self, x: Array) -> tuple[Array, Array]:
        r, J = np.empty(self.count), np.zeros((self.count, self.size))
        row = 0
        for k, name in enumerate(self.names):
            lens, camera = self.lens(x, k), self.camera_pose(x, k).vector()
            for pose, s in self.usable[name].items():
                b = self.board_at(self.poses.index(pose))
                part = slice(row, row + 2 * len(s))
                row = part.stop
                turn, shift, *d = cv2.composeRT(x[b][:3], x[b][3:], camera[:3], camera[3:])
                pixels, D = cv2.projectPoints(
                    self.board.corners[s.ids], turn, shift, lens.matrix(), lens.values[4:]
                )
                r[part] = (pixels.reshape(-1, 2) - s.pixels).ravel() / CORNER
                # columns: rotation 3, translation 3, fx, fy, cx, cy, k1, k2, p1, p2, k3; and
                # composeRT's: d r3 / d r1, t1, r2, t2, then d t3 / d the same
                wrt = D[:, :6] @ np.block([d[:4], d[4:]])
                J[part, b] = wrt[:, :6] / CORNER
                if k > 0:
                    J[part, self.camera_at(k)] = wrt[:, 6:] / CORNER
                J[part, self.lens_at[k]] = D[:, 6:15][:, lens.free] / CORNER
        return r, J


def _result(bundle: _Bundle, solution: Solution, nominal: Sequence[Camera]) -> CameraSolution:
    x = solution.x
    focal = {
        n: float(max(solution.deviation[at[:2]] / x[at[:2]], default=0.0))
        for n, at in zip(bundle.names, bundle.lens_at, strict=True)
    }
    for name, deviation in focal.items():
        if not deviation < LOOSE:
            raise _open_lens(name, len(bundle.usable[name]), deviation)
    found = []
    for k, c in enumerate(nominal):
        lens, pose = bundle.lens(x, k), bundle.camera_pose(x, k)
        K, R, t = lens.matrix(), pose.rotation, pose.translation
        K[0, 1] = lens.skew
        try:
            found.append(replace(c, K=K, R=R, t=t, distortion=lens.values[4:]))
        except ValueError as error:
            advice = "capture the board in the corners of its image"
            raise CalibrationError(f"{error}: {advice}") from error
    frame = align_devices(found, nominal)
    residuals, row = {}, 0
    for name in bundle.names:
        count = 2 * sum(len(s) for s in bundle.usable[name].values())
        residuals[name] = CORNER * solution.residual[row : row + count].reshape(-1, 2)
        row += count
    return CameraSolution(
        cameras=tuple(frame.inverse().in_frame(c) for c in found),
        board_to_world={
            p: frame @ Rigid.from_vector(x[bundle.board_at(k)]) for k, p in enumerate(bundle.poses)
        },
        rms={n: float(np.sqrt((r**2).sum(axis=1).mean())) for n, r in residuals.items()},
        observations={n: (len(s), sum(map(len, s.values()))) for n, s in bundle.usable.items()},
        focal_deviation=focal,
        position_deviation={
            n: 0.0 if k == 0 else _position_deviation(solution, bundle.camera_at(k))
            for k, n in enumerate(bundle.names)
        },
        residuals=residuals,
    )


def _position_deviation(solution: Solution, at: Ints) -> float:
    """Standard deviation of the position, metres."""
    C = solution.covariance[np.ix_(at, at)]
    _, J = numeric(lambda v: Rigid.from_vector(v).inverse().translation)(solution.x[at])
    return float(np.sqrt(np.trace(J @ C @ J.T)))
