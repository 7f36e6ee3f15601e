"""Indirect light in one view, path-traced when the page's view is at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from appearance import HairScene
from appearance.render.coverage import coverage
from appearance.render.olat import render_indirect, spread_out
from appearance.render.smoothed import smoothed
from reconstruction import Camera, Light
from reconstruction.arrays import Array, Floats
from reconstruction.options import Count, options

SIGMA = 0.8
"""Standard deviation, pixels, of the filter of traced light. A wider one blurs more than it
reduces the noise of `RestOptions.spp` paths where most light is indirect."""
_OTHER = 0.02
"""Weight of a head pixel for hair, and of a hair pixel for the head."""


@options
class RestOptions:
    """`spp` paths per pixel of at most `max_depth` vertices; later vertices sample `deep_lights`
    lights."""

    spp: Count = 96
    max_depth: Count = 24
    deep_lights: Count = 8


def indirect_in_view(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[tuple[Light, Array]],
    options: RestOptions,
) -> Floats:
    """Indirect radiance in the view of `camera` under `lights` with weights (3,).

    Returns `(2, H, W, 4)`, for hair and for head: radiance averaged over `SIGMA` pixels times a
    weight, and the weight: the coverage of the pixel by hair or head. Pixels of the other have a
    small weight, which counts where there are no others: a strand in front of the face gets the
    face's light.
    """
    share = coverage(scene, camera)
    is_hair = share["hair"] >= share["head"]
    index = np.flatnonzero((share["hair"] + share["head"]).ravel() > 0)
    out = np.zeros((2, camera.height, camera.width, 4), np.float32)
    if not (len(index) and lights):
        return out
    how = {"spp": options.spp, "max_depth": options.max_depth, "deep_lights": options.deep_lights}
    olat = render_indirect(scene, camera, [light for light, _ in lights], index, **how)
    weights = np.array([weight for _, weight in lights], np.float32)
    light = np.einsum("lpc,lc->pc", olat, weights)
    smooth = smoothed(spread_out(light[None], index, camera), share, SIGMA)[0]
    for k, (kind, mask) in enumerate((("hair", is_hair), ("head", ~is_hair))):
        own = np.dstack([smooth, share[kind]])[mask]
        out[k][mask], out[1 - k][mask] = own, _OTHER * own
    return out
