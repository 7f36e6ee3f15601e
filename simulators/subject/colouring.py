"""Hair of several colours: melanins and white strands side by side, dark roots, lighter tips."""

from __future__ import annotations

import numpy as np

from appearance.bsdf.absorption import of_melanin
from reconstruction import Strands
from reconstruction.arrays import Array

LAYERS = 32
"""Places along a strand with an absorption of their own."""
MELANINS = ((0.45, 1.3, 0.0), (0.35, 0.45, 0.05), (0.20, 0.15, 0.9))
"""Share of the strands, eumelanin and pheomelanin of brown, light brown and red hair (per fibre
radius, d'Eon et al. 2011); each strand has its own concentration, 25 % about these."""
WHITE, AT_TEMPLES = 0.08, 0.5
"""Share of strands without pigment: anywhere, and at most at the temples."""
WHITE_SIGMA = (0.006, 0.009, 0.02)
"""Absorption of white hair: keratin's."""
ROOTS, TIPS = 1.5, 0.35
"""Factors on a strand's absorption, from dark roots through grown-out dye to light tips."""


def mixed_absorption(strands: Strands, seed: int) -> Array:
    """Absorption per fibre radius of each strand, from root to tip: `(LAYERS, S, 3)`."""
    rng, count = np.random.default_rng([seed, 0xC01]), len(strands)
    shares = np.array(MELANINS)
    kind = rng.choice(len(shares), count, p=shares[:, 0])
    amount = np.exp(0.25 * rng.normal(size=count))
    sigma = np.stack(of_melanin(*shares[kind, 1:].T), axis=-1) * amount[:, None]
    # grown out by a length of its own: the same centimetres of root on short and long strands
    along = np.linspace(0, 1, LAYERS)[:, None] * strands.lengths()
    grown = rng.uniform(0.025, 0.045, count)
    lightened = 1 / (1 + np.exp((grown - along) / 0.006))
    out = sigma * (ROOTS + (TIPS - ROOTS) * lightened)[..., None]
    side = np.abs(strands.roots[:, 0].astype(float))
    temples = np.clip(2 * side / max(side.max(), 1e-9) - 1, 0, 1)
    white = rng.random(count) < WHITE + (AT_TEMPLES - WHITE) * temples
    out[:, white] = WHITE_SIGMA
    return np.asarray(out)
