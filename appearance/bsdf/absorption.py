"""A fibre's absorption from pigments, or from the colour of dense hair.

Both work on Dr.Jit arrays and are differentiable; `appearance.bsdf.longitudinal` has the
second in NumPy, with its inverse.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from appearance.bsdf.longitudinal import LEAST_COLOUR, bracket

EUMELANIN = (0.419, 0.697, 1.37)
"""Absorption of black-brown pigment per unit of concentration (d'Eon et al. 2011), linear RGB."""
PHEOMELANIN = (0.187, 0.4, 1.05)
"""Absorption of red-yellow pigment per unit of concentration (d'Eon et al. 2011), linear RGB."""


def of_melanin(eumelanin: Any, pheomelanin: Any) -> tuple[Any, Any, Any]:
    """sigma_a per fibre radius in three channels, from the concentrations of the two pigments."""
    red, green, blue = (
        eumelanin * e + pheomelanin * p for e, p in zip(EUMELANIN, PHEOMELANIN, strict=True)
    )
    return red, green, blue


def of_colour(colour: Any, beta_n: Any) -> Any:
    """sigma_a per fibre radius that gives dense hair the multiple-scattering albedo `colour`.

    (log C / P(beta_n))² with Chiang's polynomial P (2016, eq. 9). C is clamped to [1e-6, 1]: above
    1 the square would alias to albedos below.
    """
    return (dr.log(dr.clip(colour, LEAST_COLOUR, 1.0)) / bracket(beta_n)) ** 2
