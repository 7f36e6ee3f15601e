"""Captured frames under any light, as weighted sums of OLAT frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from appearance.render.environment_maps import check_environment, subdivided
from reconstruction import Camera, Capture, Light
from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.geometry.blocks import block_means

MEMORY = 1 << 30
"""Bytes that one camera's frames may take; larger ones are reduced by whole factors."""
_ROWS = 64
"""Least number of rows of a map; larger texels are subdivided."""
_DIM = 1e-3
"""Share of the median light's irradiance in a channel below which a light has weight 0."""


class LightSums:
    """A camera's OLAT frames `(L, H, W, 3)`, in memory; `names (L,)` are the lights'.

    Large frames are averaged over `reduced` × `reduced` pixels. Raises `MissingFrame` if a light
    has no frame.
    """

    def __init__(self, capture: Capture, camera: str, memory: int = MEMORY) -> None:
        at: Camera = capture.rig.camera(camera)
        self.names = [n for n in capture.olat_lights() if capture.has_light(n, camera)]
        count = max(1, len(self.names))
        self.reduced = 1
        while 12 * count * (at.height // self.reduced) * (at.width // self.reduced) > memory:
            self.reduced += 1
        height, width = at.height // self.reduced, at.width // self.reduced
        self.responses = np.empty((len(self.names), height, width, 3), np.float32)
        for i, name in enumerate(self.names):
            self.responses[i] = block_means(capture.light(name, camera)[0], self.reduced)

    def __call__(self, weights: Mapping[str, ArrayLike]) -> Floats:
        """Radiance `(H, W, 3)` under lights by name, each at its `weights`: one number or three.

        Raises `ValueError` for a light that this camera has no frame of.
        """
        unknown = sorted(set(weights) - set(self.names))
        if unknown:
            raise ValueError(f"no frames of the lights {unknown[:5]}; there are {len(self.names)}")
        out = np.zeros(self.responses.shape[1:], np.float32)
        for name, weight in weights.items():
            out += self.responses[self.names.index(name)] * np.asarray(weight, np.float32)
        return out


def weights_of_environment(
    lights: Sequence[Light], envmap: AnyFloats, rotation_deg: float = 0.0
) -> Array:
    """Factors `(L, 3)` on `lights` that approximate a map.

    Every direction of the lat-long map `(h, w, 3)` (as in `render_environment`) is assigned to the
    nearest light with that channel; a factor is the irradiance of its cell over the light's own at
    the origin.
    """
    image = subdivided(check_environment(envmap, "environment").astype(float), _ROWS)
    height, width = image.shape[:2]
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width) + np.radians(rotation_deg)
    sine = np.sin(theta)[:, None]
    up = np.broadcast_to(np.cos(theta)[:, None], (height, width))
    directions = np.stack([sine * np.cos(phi), sine * np.sin(phi), up], axis=-1).reshape(-1, 3)
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    solid = np.repeat((edges[:-1] - edges[1:]) * 2 * np.pi / width, width)
    position = np.array([light.position for light in lights])
    unit = position / np.linalg.norm(position, axis=1, keepdims=True)
    own, sent = irradiance(lights), image.reshape(-1, 3) * solid[:, None]
    usual = [np.median(x[x > 0]) if x.any() else 0.0 for x in own.T]
    shines = (own > 0) & (own >= _DIM * np.array(usual))
    weights = np.zeros_like(own)
    for lit in np.unique(shines, axis=1).T:  # of white lights one set, of red, green and blue three
        some, colours = np.flatnonzero(lit), (shines == lit[:, None]).all(axis=0)
        if len(some):
            nearest = some[_nearest(directions, unit[some])]
            power = np.stack([np.bincount(nearest, x, len(own)) for x in sent[:, colours].T], -1)
            weights[np.ix_(some, colours)] = power[some] / own[np.ix_(some, colours)]
    return weights


def reassigned(lights: Sequence[Light], weights: Array, there: Bools) -> Array:
    """`weights (L, 3)` moved to the lights that are `there (L,)`: each other light's irradiance
    goes to the nearest one with its channels."""
    own, unit = irradiance(lights), np.array([x.position for x in lights])
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    out = np.where(there[:, None], weights, 0.0)
    for i in np.flatnonzero(~there):
        power = weights[i] * own[i]
        able = np.flatnonzero(there & ((own > 0) | (power == 0)).all(axis=1))
        if power.any() and len(able):
            j = able[(unit[able] @ unit[i]).argmax()]
            out[j] += np.divide(power, own[j], out=np.zeros(3), where=own[j] > 0)
    return out


def _nearest(directions: Array, unit: Array) -> Ints:
    """The number of the nearest of `unit (L, 3)` to each of `directions (D, 3)`."""
    out = np.empty(len(directions), np.int64)
    for part in range(0, len(directions), 65536):
        block = slice(part, part + 65536)
        out[block] = (directions[block] @ unit.T).argmax(axis=1)
    return out


def irradiance(lights: Sequence[Light]) -> Array:
    """Irradiance of each light at the origin, across its ray: `(L, 3)`, W/m²."""
    origin = np.zeros(3)
    return np.array([x.irradiance(origin) for x in lights]).reshape(-1, 3)


def few_lights(lights: Sequence[Light], weights: Array, most: int) -> list[tuple[int, Array]]:
    """At most `most` of `lights` that approximate all at their `weights (L, 3)`: (number, weight).

    Lights are grouped by the nearest chosen one, which is the group's brightest and has the group's
    irradiance. A light only represents channels that it has, unless `most` leaves no other.
    """
    own = irradiance(lights)
    power = weights * own
    out = []
    for chosen, members in _groups(lights, power, most):
        total, given = power[members].sum(axis=0), own[chosen]
        out.append((chosen, np.divide(total, given, out=np.zeros(3), where=given > 0)))
    return out


def lights_in_turn(
    lights: Sequence[Light], weights: Array, most: int, turns: int
) -> list[list[tuple[int, Array]]]:
    """Of each group of `few_lights` the members, with weights, that represent it in turn.

    A member's frequency is proportional to its irradiance, so that the mean over many turns is that
    of all lights.
    """
    power = weights * irradiance(lights)
    unit = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    out = []
    for chosen, members in _groups(lights, power, most):
        bright = power[members].sum(axis=1)
        order = (unit[members] @ unit[chosen]).argsort()  # those that follow each other lie apart
        share = bright[order] / bright.sum()
        places = [_radical_inverse(t + 1) for t in range(turns if len(members) > 1 else 1)]
        picks = np.minimum(np.searchsorted(share.cumsum(), places), len(members) - 1)
        out.append([(int(members[order[p]]), weights[members[order[p]]] / share[p]) for p in picks])
    return out


def _groups(lights: Sequence[Light], power: Array, most: int) -> list[tuple[int, Ints]]:
    """The brightest and all numbers of each group of `few_lights`, of irradiance `power (L, 3)`."""
    bright = power.sum(axis=1)
    lit = np.flatnonzero(bright > 0)
    if len(lit) == 0:
        return []
    unit = np.array([lights[int(i)].position for i in lit])
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    sends, shines = power[lit] > 0, irradiance(lights)[lit] > 0

    def alike(others: list[int]) -> Array:
        """Cosines between the lit and `others`; less than any where a colour would be lost."""
        return unit @ unit[others].T - 4.0 * (sends[:, None] & ~shines[others]).any(axis=-1)

    chosen = [int(bright[lit].argmax())]
    while len(chosen) < min(most, len(lit)):
        # what is badly stood for: its power times its squared distance to the nearest chosen
        cost = bright[lit] * (1 - alike(chosen).max(axis=1)).clip(0)
        if cost.max() <= 0:
            break
        chosen.append(int(cost.argmax()))
    group = alike(chosen).argmax(axis=1)
    return [(int(lit[c]), lit[group == k]) for k, c in enumerate(chosen)]


def _radical_inverse(i: int) -> float:
    """Van der Corput's sequence in base 2."""
    return int(f"{i:b}"[::-1], 2) / (1 << i.bit_length())
