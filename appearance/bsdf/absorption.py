"""A fibre's absorption from pigments, also on Dr.Jit arrays."""

from __future__ import annotations

from typing import Any

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
