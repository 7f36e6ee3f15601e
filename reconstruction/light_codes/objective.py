"""The objective of a depth: the line through a point and the agreement of all views (Sun §4.2).

For Dr.Jit's CPU and GPU back ends; `reference` in the tests is the same in NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from reconstruction.light_codes.device_views import DeviceViews

MATCH_POWER, ANGLE_POWER = 1, 64
"""Powers of the share of equal bits and of the cosine in the objective.

Sun's Eq. 5 has power 1, at which random lines average 0.64; at 64, lines 8 degrees apart count
half. Its confidence W is left out: it draws pixels between bright strands to these.
"""

LINE_MATCH_POWER = 16
"""Of the share of equal bits, in a view's weight for the direction."""


def power(x: Any, n: int) -> Any:
    """`x` to the `n`, at least 1, by squaring."""
    half = power(x * x, n // 2) if n > 1 else 1.0
    return half * x if n % 2 else half


OUTLIER_POWER = 128
"""Of the cosine between a view's line and the first direction, in the weights of the second."""


Triple = tuple[Any, Any, Any]


class Pixels:
    """Reference pixels, one a lane. No dataclass: Dr.Jit would carry it through every loop.

    `origin` and `ray` give the point at depth d along the camera's axis: origin + d · ray. `code`
    holds the words of the lightcode. `view` is the reference's number; `neighbours` (device array)
    begins with it, has `count` views, and `visible` has bit n set where neighbour n sees the pixel.
    """

    def __init__(
        self, origin: Any, ray: Any, code: list[Any], view: Any, neighbours: Any, visible: Any
    ) -> None:
        self.origin, self.ray, self.code, self.view = origin, ray, code, view
        self.neighbours, self.visible = neighbours, visible
        self.count = dr.opaque(type(neighbours), len(neighbours))

    def at(self, depth: Any) -> Any:
        """The points at `depth`."""
        return self.origin + depth * self.ray


@dataclass(frozen=True, eq=False)
class Line:
    """A direction through a point.

    With the singular values s1 >= s2 >= s3 of the planes' normals: `spread` is s2 / s1, 0 where all
    planes are parallel and any direction in them would do; `misfit` is s3 / s2, 0 where all planes
    share one line.
    """

    direction: Any
    spread: Any
    misfit: Any


@dr.syntax
def line_through(views: DeviceViews, pixels: Pixels, point: Any) -> Line:
    """The direction that lies in the planes of the visible views' lines (Sun Eq. 4).

    The singular vector of the least singular value of the plane normals, weighted by the match of
    lightcodes; then reweighted by each line's agreement with it, against outliers.
    """
    zero = views.types.Array3f(0, 0, 0)
    first = _weighed_line(views, pixels, point, zero, 0)
    return _weighed_line(views, pixels, point, first.direction, OUTLIER_POWER)


@dr.syntax
def _weighed_line(views: DeviceViews, pixels: Pixels, point: Any, along: Any, trust: int) -> Line:
    """The direction, lines weighted by their cosine to `along` to the power `trust`."""
    t = views.types
    xx, yy, zz = t.Float(0), t.Float(0), t.Float(0)
    xy, xz, yz = t.Float(0), t.Float(0), t.Float(0)
    n = t.UInt32(0)
    while n < pixels.count:
        view = dr.gather(t.UInt32, pixels.neighbours, n)
        sees = (pixels.visible >> n) & 1 == 1
        h = views.projection(view, point, 1)
        compared = views.compared_lights(view, pixels.view)
        at = views.sample(views.corner(view), compared, pixels.code, h, sees)
        line = t.Array3f(-at.ly, at.lx, at.x * at.ly - at.y * at.lx)
        normal = views.across(view, line)
        square = dr.squared_norm(normal)
        weight = dr.select(
            at.there & (square > 0),
            power(at.equal, LINE_MATCH_POWER) / dr.maximum(square, 1e-30),
            0,
        )
        if trust > 0:
            cosine2 = at.cosine2(views.projection(view, along, 0))
            weight *= power(cosine2, trust // 2)
        xx += weight * normal.x * normal.x
        yy += weight * normal.y * normal.y
        zz += weight * normal.z * normal.z
        xy += weight * normal.x * normal.y
        xz += weight * normal.x * normal.z
        yz += weight * normal.y * normal.z
        n += 1
    return smallest_axis(t, (xx, yy, zz), (xy, xz, yz))


def smallest_axis(t: Any, diagonal: Triple, beside: Triple) -> Line:
    """Eigenvector of a positive 3x3 matrix's smallest eigenvalue, in closed form.

    The matrix has `diagonal` (xx, yy, zz) and `beside` it (xy, xz, yz), lane by lane.

    Eigenvalues by the trigonometric formula, the vector as the longest cross product of two rows
    of A - λI: errors are of the order of float32's rounding over `spread`².
    """
    trace = diagonal[0] + diagonal[1] + diagonal[2]
    scale = dr.maximum(trace, 1e-30)
    xx, yy, zz, xy, xz, yz = (a / scale for a in (*diagonal, *beside))
    mean = t.Float(1.0 / 3)
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    off = xy * xy + xz * xz + yz * yz
    p = dr.sqrt(dr.maximum((dx * dx + dy * dy + dz * dz + 2 * off) / 6, 1e-20))
    det = dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz)
    angle = dr.acos(dr.clip(det / (2 * p * p * p), -1, 1)) / 3
    big = mean + 2 * p * dr.cos(angle)
    small = mean + 2 * p * dr.cos(angle + 2 * dr.pi / 3)
    middle = 1 - big - small
    r0 = t.Array3f(xx - small, xy, xz)
    r1 = t.Array3f(xy, yy - small, yz)
    r2 = t.Array3f(xz, yz, zz - small)
    best = dr.cross(r0, r1)
    for other in (dr.cross(r0, r2), dr.cross(r1, r2)):
        best = dr.select(dr.squared_norm(other) > dr.squared_norm(best), other, best)
    length = dr.norm(best)
    direction = dr.select(length > 1e-12, best / dr.maximum(length, 1e-12), t.Array3f(0, 0, 0))
    middle, small = dr.maximum(middle, 0), dr.maximum(small, 0)
    misfit = dr.sqrt(small / dr.maximum(middle, 1e-12))
    spread = dr.select(trace > 1e-12, dr.sqrt(middle / dr.maximum(big, 1e-12)), 0)
    return Line(direction, spread, dr.minimum(misfit, 1))


@dr.syntax
def agreement(views: DeviceViews, pixels: Pixels, point: Any, along: Any, samples: Any) -> Any:
    """Sun's Eq. 6 over the number of its terms: 0 to 1.

    `samples` points stand `along` apart about `point`; each term is the share of equal bits times
    the cosine between the projected line and the view's own, to their powers, and 0 off the hair.
    """
    t = views.types
    total, terms = t.Float(0), t.Float(0)
    n = t.UInt32(0)
    while n < pixels.count:
        view = dr.gather(t.UInt32, pixels.neighbours, n)
        sees = (pixels.visible >> n) & 1 == 1
        middle = views.projection(view, point, 1)
        step = views.projection(view, along, 0)
        compared = views.compared_lights(view, pixels.view)
        frame = views.corner(view)
        h = middle - 0.5 * (t.Float(samples) - 1) * step
        s = t.UInt32(0)
        while s < samples:
            at = views.sample(frame, compared, pixels.code, h, sees)
            share = power(at.cosine2(step), ANGLE_POWER // 2) * power(at.equal, MATCH_POWER)
            total += dr.select(at.there, share, 0)
            h += step
            s += 1
        terms += dr.select(sees, t.Float(samples), 0)
        n += 1
    return total / dr.maximum(terms, 1)
