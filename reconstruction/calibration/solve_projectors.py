"""Projectors as inverse cameras, from the rows of a sweep decoded on a board in known poses.

Rows give one coordinate. All planes of light of a pinhole projector contain its x axis through its
centre; rows determine that line (4 parameters) and row against angle about it (3: focal length and
principal point along y, and the rotation). The centre's position along the line, and focal length
and principal point along x, stay nominal; no plane of light depends on them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from reconstruction.arrays import Array, Bools, Ints
from reconstruction.calibration.boards import Board, CalibrationError
from reconstruction.calibration.least_squares import Solution, minimise, numeric
from reconstruction.calibration.solve_cameras import CameraSolution
from reconstruction.capture.folder import Capture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.projectors import Projector
from reconstruction.geometry.rigid_motion import Rigid
from reconstruction.images.silhouettes import dark_response
from reconstruction.light_planes.peaks import find_peaks

MOST = 20_000  # points used
HEAD = 0.1  # metres: radius around the points' middle where planes are evaluated
LOOSE = 2e-3  # metres: largest standard deviation of planes there


@dataclass(frozen=True, eq=False)
class DecodedRows:
    """World `points (N, 3)`, their `row (N,)` and its `deviation (N,)`, in rows."""

    points: Array
    row: Array
    deviation: Array

    @classmethod
    def join(cls, parts: Sequence[DecodedRows]) -> DecodedRows:
        """Concatenated and thinned to `MOST`."""
        if not parts:
            return cls(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        columns = zip(*((p.points, p.row, p.deviation) for p in parts), strict=True)
        joined = [np.concatenate(c) for c in columns]
        every = max(1, -(-len(joined[0]) // MOST))
        return cls(*(a[::every] for a in joined))


@dataclass(frozen=True, eq=False)
class ProjectorSolution:
    """The calibrated `projector`; `points` used; `rms` of the rows' residuals, rows.

    Standard deviations: `plane_deviation` (metres) of the planes of light, the largest within
    `HEAD` of the points' middle; `axis_deviation` (metres) of their common line; `turn_deviation`
    (radians) of the rotation.
    """

    projector: Projector
    points: int
    rms: float
    plane_deviation: float
    axis_deviation: float
    turn_deviation: float


UNDETERMINED = (
    "the centre's position along the projector's x axis, K[0, 0], K[0, 1], K[0, 2]: rows do not "
    "determine them and no plane of light depends on them; kept as nominal"
)


def rows_on_board(
    capture: Capture, camera: Camera, projector: str, board: Board, board_to_world: Rigid
) -> DecodedRows:
    """Rows of `projector`'s sweep on the board decoded by a calibrated `camera`, one per pixel.

    Saturated pixels and pixels on an edge of the print, which bias the peak, are excluded.
    """
    peaks = find_peaks(capture, camera.name, projector)
    first = np.unique(peaks.pixel @ (1, camera.width), return_index=True)[1]
    first = first[~peaks.saturated[first]]
    rays = camera.rays(peaks.pixel[first].astype(float)) @ board_to_world.rotation
    origin = board_to_world.inverse()(camera.center)
    if not len(rays) or origin[2] >= 0:
        return DecodedRows.join([])
    distance = -origin[2] / np.where(rays[:, 2] > 1e-6, rays[:, 2], np.inf)
    flat = origin + distance[:, None] * rays
    footprint = np.abs(origin[2]) / camera.K[0, 0]
    slant = np.median(np.where(rays[:, 2] > 1e-6, 1 / np.maximum(rays[:, 2], 0.1), 10.0))
    good = (distance > 0) & board.plain(flat[:, :2], float(1.2 * footprint * slant))
    flat, first = flat[good], first[good]
    return DecodedRows(board_to_world(flat), peaks.row[first], peaks.deviation[first])


def calibrate_projector(nominal: Projector, rows: DecodedRows) -> ProjectorSolution:
    """The projector that fits `rows`, in the frame of the points.

    `nominal` gives size, line width, intensity and the parameters that rows do not determine.
    Raises `CalibrationError` for too few or coplanar points, which determine only five of seven
    parameters.
    """
    where = f"projector {nominal.name}"
    if len(rows.row) < 50:
        raise CalibrationError(
            f"{where}: {len(rows.row)} points were decoded on the board, expected 50 or "
            "more: check "
            "that the board captures have a sweep and that it reaches the printed side"
        )

    def residual(x: Array) -> Array:
        p = _projector(nominal, x)
        local = rows.points @ p.R.T + p.t
        return (p.K[1, 1] * local[:, 1] / local[:, 2] + p.K[1, 2] - rows.row) / rows.deviation

    solution = minimise(numeric(residual), _linear(nominal, rows))
    loose = _plane_deviation(nominal, solution, rows.points.mean(axis=0))
    if not loose < LOOSE:
        raise CalibrationError(
            f"{where}: {len(rows.row)} decoded points determine its planes of light to "
            f"{loose * 1e3:.3g} mm within {HEAD * 1e3:g} mm of the board's middle (limit "
            f"{LOOSE * 1e3:g} mm): {_shape(rows.points)}; capture the sweep on boards at several "
            "distances and tilts"
        )
    rms = float(np.sqrt(np.mean((solution.residual * rows.deviation) ** 2)))
    axis, turn = (float(solution.deviation[k].max()) for k in (np.s_[3:5], np.s_[:3]))
    found = _projector(nominal, solution.x)
    return ProjectorSolution(found, len(rows.row), rms, loose, axis, turn)


def _plane_deviation(nominal: Projector, solution: Solution, middle: Array) -> float:
    """Largest standard deviation over a ball around `middle`, metres."""
    way = np.random.default_rng(0).standard_normal((200, 3))
    points = middle + HEAD * way / np.linalg.norm(way, axis=1, keepdims=True)

    def row(x: Array) -> Array:
        return np.asarray(_projector(nominal, x).project(points)[0][:, 1])

    _, J = numeric(row)(solution.x)
    found = _projector(nominal, solution.x)
    variance = np.einsum("ni,ij,nj->n", J, solution.covariance, J)
    metres = np.sqrt(variance) * found.project(points)[1] / found.K[1, 1]
    return float(np.abs(metres).max())


def projector_intensities(
    projectors: Sequence[Projector],
    captures: Mapping[str, Capture],
    cameras: CameraSolution,
    board: Board,
    white: float,
) -> dict[str, Array]:
    """Radiant intensities `(3,)` from the tracking frames (all projectors on), W/sr per channel.

    The print is Lambertian; its paper has the albedo `white`, its ink an unknown one. A pixel's
    radiance is the sum over projectors of albedo / π · I · cosine / distance², of paper and ink by
    their shares of the pixel; both are solved by non-negative least squares.
    """
    rows: list[Array] = []
    values: list[Array] = []
    for pose, capture in captures.items():
        steps = capture.of_kind("tracking")[:1]
        if not steps or pose not in cameras.board_to_world:
            continue
        to_world = cameras.board_to_world[pose]
        for camera in cameras.cameras:
            if not capture.has(steps[0], camera.name):
                continue
            image, saturated = dark_response(capture, steps[0], camera.name)
            pixels, points, share = _printed(camera, board, to_world)
            x, y = pixels.T
            ok = ~saturated[y, x] & _sure(projectors, points)
            light = _arriving(projectors, points[ok], -to_world.rotation[:, 2])
            rows.append(np.hstack([light * share[ok, None], light * (1 - share[ok, None])]))
            values.append(image[y[ok], x[ok]])
    if not rows:
        return {}
    A, b = np.concatenate(rows) * (white / np.pi), np.concatenate(values)
    lit = (A > 0).sum(axis=0)[: len(projectors)]
    if not lit.any():
        return {}
    channels = np.stack([nnls(A, b[:, c])[0] for c in range(3)], axis=1)
    return {p.name: channels[k] for k, p in enumerate(projectors) if lit[k] >= 50}


def _printed(camera: Camera, board: Board, to_world: Rigid) -> tuple[Ints, Array, Array]:
    """Pixels `(N, 2)` on the print, points `(N, 3)` there, and each pixel's share of paper."""
    to_board = to_world.inverse()
    origin = to_board(camera.center)
    y, x = np.mgrid[0 : camera.height : 2, 0 : camera.width : 2]
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    if origin[2] >= 0:
        return pixels[:0], np.zeros((0, 3)), np.zeros(0)
    sub = (np.arange(4) + 0.5) / 4 - 0.5
    offsets = np.stack(np.meshgrid(sub, sub), axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels[:, None] + offsets) @ to_world.rotation
    ahead = (rays[..., 2] > 0.2).all(axis=1)  # at grazing angles paper is glossy
    pixels, rays = pixels[ahead], rays[ahead]
    at = origin - (origin[2] / rays[..., 2:]) * rays
    inside = ((at[..., :2] > 0) & (at[..., :2] < board.size)).all(axis=(1, 2))
    paper = 1 - board.ink(at[inside, :, :2]).mean(axis=1)
    return pixels[inside], to_world(at[inside].mean(axis=1)), paper


def _sure(projectors: Sequence[Projector], points: Array) -> Bools:
    """Points clearly inside or outside each beam, whose sides rows do not determine."""
    sure = np.ones(len(points), bool)
    for p in projectors:
        at, depth = p.project(points)
        half = 0.5 * np.array([p.width, p.height])
        edge = np.abs(at - half + 0.5) / half
        sure &= (depth <= 0) | (edge < 0.85).all(axis=1) | (edge > 1.15).any(axis=1)
    return sure


def _arriving(projectors: Sequence[Projector], points: Array, normal: Array) -> Array:
    """Cosine over squared distance `(N, P)`, 0 outside a beam."""
    out = []
    for p in projectors:
        towards = p.center - points
        squared = (towards**2).sum(axis=1)
        at, depth = p.project(points)
        lit = p.inside(at) & (depth > 0)
        out.append(np.where(lit, np.maximum(towards @ normal, 0) / squared**1.5, 0.0))
    return np.stack(out, axis=1)


def _projector(nominal: Projector, x: Array) -> Projector:
    """From rotation (3), the centre's y and z (2) in the device's frame, log focal length, cy."""
    turn = Rigid.from_vector(np.append(x[:3], np.zeros(3))).rotation
    R = turn @ nominal.R
    # nominal centre, shifted across the axis
    center = nominal.center + R.T @ (0.0, x[3], x[4])
    K = nominal.K.copy()
    K[1, 1], K[1, 2] = K[1, 1] * np.exp(x[5]), x[6]
    return replace(nominal, K=K, R=R, t=-R @ center)


def _linear(nominal: Projector, rows: DecodedRows) -> Array:
    """Parameters from `rows` by the direct linear transform; nominal if ill-conditioned."""
    start = np.array([0.0, 0, 0, 0, 0, 0, nominal.K[1, 2]])
    middle = rows.points.mean(axis=0)
    size = np.abs(rows.points - middle).max()
    X = np.column_stack([(rows.points - middle) / size, np.ones(len(rows.row))])
    v0, dv = rows.row.mean(), max(float(np.ptp(rows.row)), 1.0)
    v = (rows.row - v0) / dv
    A = np.column_stack([X, -v[:, None] * X]) / rows.deviation[:, None]
    _, values, vt = np.linalg.svd(A, full_matrices=False)
    if values[-2] < 3 * max(values[-1], 1e-9 * values[0]):
        return start  # nearly coplanar points: the deviations show it
    a, c = vt[-1][:4], vt[-1][4:]
    a = dv * a + v0 * c
    # to metres about the world's origin
    a, c = (np.append(q[:3] / size, q[3] - q[:3] @ middle / size) for q in (a, c))
    length = np.linalg.norm(c[:3])
    a, c = a / length, c / length
    if c[:3] @ middle + c[3] < 0:
        a, c = -a, -c
    forward = c[:3]
    cy = float(a[:3] @ forward)
    down = a[:3] - cy * forward
    fy = float(np.linalg.norm(down))
    down = down / fy
    R = np.stack([np.cross(down, forward), down, forward])
    if not 0.2 < fy / nominal.K[1, 1] < 5:
        return start
    # y and z of the centre: the planes a - cy c = 0 and c = 0 hold it
    yz = np.array([-(a[3] - cy * c[3]) / fy, -c[3]])
    turn = Rigid(R @ nominal.R.T, np.zeros(3)).vector()[:3]
    return np.array([*turn, *(yz - (R @ nominal.center)[1:]), np.log(fy / nominal.K[1, 1]), cy])


def _shape(points: Array) -> str:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return f"the points extend over {', '.join(f'{s * 1e3:.3g}' for s in spread)} mm (deviation)"
