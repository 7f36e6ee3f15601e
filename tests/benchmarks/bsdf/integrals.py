"""Measurements of a hair BSDF: its integrals over the sphere, by quadrature and by sampling.

For the tests and for the table that sets ours beside Mitsuba's `hair`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.bsdf import reference as ref
from appearance.bsdf.lobes import Fibre
from reconstruction.array_backend import chosen_variant, for_kernels
from reconstruction.arrays import Array

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(7)


@dataclass(frozen=True)
class Case:
    """A fibre and a known direction; `h` is the sine of gamma, angles are in degrees."""

    beta_m: float = 0.3
    beta_n: float = 0.3
    theta_deg: float = 0.0
    h: float = 0.0
    eta: float = 1.55
    tilt_deg: float = 0.0
    sigma_a: float = 0.0

    @property
    def wi(self) -> Array:
        """The known direction `(3,)`; exactly across the normal at |h| = 1."""
        theta = np.radians(self.theta_deg)
        flat = np.cos(theta)
        return np.array([-flat * self.h, np.sin(theta), flat * np.sqrt(1 - self.h**2)])

    @property
    def optics(self) -> dict[str, float]:
        """The fields of `Fibre` but the absorption."""
        tilt = float(np.radians(self.tilt_deg))
        return {"beta_m": self.beta_m, "beta_n": self.beta_n, "eta": self.eta, "tilt": tilt}


def array_types(double: bool) -> tuple[Any, Any]:
    """(float, vector of 3) Dr.Jit types of the back end that Mitsuba's variant has.

    Those of float64 are LLVM's: on a GPU, Dr.Jit's division and roots have seven digits in either.
    """
    if double:
        chosen_variant("llvm_ad_rgb")  # makes libLLVM known
    cuda = str(mi.variant()).startswith("cuda") and not double
    module: Any = dr.cuda.ad if cuda else dr.llvm.ad
    return (module.Float64, module.Array3f64) if double else (module.Float, module.Array3f)


def fibre(case: Case, double: bool) -> Fibre:
    """The fibre of `case`, in variables that kernels read from memory: one kernel for all cases."""
    number, vector = array_types(double)
    values = {name: dr.opaque(number, value) for name, value in case.optics.items()}
    return Fibre(vector(dr.opaque(number, case.sigma_a)), **values)


def known_direction(case: Case, double: bool) -> Any:
    """`wi` of `case`, in variables that kernels read from memory."""
    number, vector = array_types(double)
    return vector(*(dr.opaque(number, float(x)) for x in case.wi))


def sphere(case: Case) -> tuple[Array, Array]:
    """Directions `(N, 3)` and weights `(N,)` whose weighted sums are integrals over the sphere.

    Gauss-Legendre on panels that shrink towards the middle of every lobe of `case`.
    """
    theta, gamma = ref.inclination(case.wi), ref.azimuth(case.wi)
    middles = [-float(ref.tilted(p, theta, case.optics["tilt"])) for p in range(ref.LOBES)]
    widths = [float(np.sqrt(ref.variance(p, case.beta_m))) for p in range(ref.LOBES)]
    along, along_weights = panels(middles, widths, -pi / 2, pi / 2)
    inner = ref.refracted_azimuth(theta, gamma, case.eta)
    turns = [float(gamma + ref.phi(p, gamma, inner)) for p in range(ref.LOBES - 1)]
    start = turns[0] - pi
    turns = [start + (t - start) % (2 * pi) for t in turns]
    # a lobe is trimmed opposite its middle
    edges = [start + (t + pi - start) % (2 * pi) for t in turns]
    scale = float(ref.logistic_scale(case.beta_n))
    around, around_weights = panels(
        [m + 2 * pi * k for m in turns for k in (-1, 0, 1)],
        [scale] * 9,
        start,
        start + 2 * pi,
        edges,
    )
    w = ref.direction(along[:, None], around).reshape(-1, 3)
    return w, np.outer(along_weights * np.cos(along), around_weights).ravel()


def panels(
    middles: list[float], widths: list[float], low: float, high: float, edges: Any = ()
) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights over [low, high], dense about `middles`.

    Panels end at multiples of its width from each middle, and at the `edges`.
    """
    reach = np.array([0.0, 1, 2.5, 5, 10, 20, 44])
    steps = np.concatenate([-reach, reach])
    breaks = [m + w * steps for m, w in zip(middles, widths, strict=True)]
    points = np.concatenate([*breaks, np.asarray(edges), np.linspace(low, high, 9)])
    points = np.unique(np.clip(points, low, high))
    half = np.diff(points) / 2
    nodes = points[:-1, None] + half[:, None] * (_NODES + 1)
    return nodes.ravel(), (half[:, None] * _WEIGHTS).ravel()


def integral(case: Case, function: Callable[[Any], Any], double: bool) -> Array:
    """Integral over the sphere of `function` of Dr.Jit directions, summed in float64.

    `function` may return several channels; the integral has as many.
    """
    number, vector = array_types(double)
    w, weights = sphere(case)
    # by columns: an array of three would compile its number of lanes into the kernel
    columns = (for_kernels(x, np.float64 if double else np.float32) for x in w.T)
    values = np.asarray(function(vector(*map(number, columns))), float)
    return np.asarray(values @ weights)


def uniforms(count: int, seed: int, double: bool) -> list[Any]:
    """Three uniform numbers per lane; of 24 bits in float32, as renderers draw them."""
    number, _ = array_types(double)
    rng = np.random.default_rng(seed)
    if double:
        return [number(for_kernels(rng.random(count), np.float64)) for _ in range(3)]
    return [number(for_kernels(rng.integers(0, 1 << 24, count) / (1 << 24))) for _ in range(3)]


def cases(count: int, seed: int = 0) -> list[Case]:
    """The ends of every parameter's range, and `count` more cases from inside; sigma_a is 0."""
    levels: list[list[float]] = [
        [0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0],
        [0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0],
        [-89.99, -80.0, -30.0, 0.0, 10.0, 60.0, 85.0, 89.9, 89.99],
        [-1.0, -0.999999, -0.5, 0.0, 0.1, 0.8, 0.99, 1.0],
        [1.0001, 1.01, 1.3, 1.55, 2.0, 3.0],
        [-10.0, 0.0, 2.0, 10.0],
    ]
    ends = np.stack(np.meshgrid(*([level[0], level[-1]] for level in levels)), -1).reshape(-1, 6)
    rng = np.random.default_rng(seed)
    inside = np.stack([rng.choice(level, count) for level in levels], -1)
    return [Case(*map(float, row)) for row in np.concatenate([ends, inside])]
