"""The lights of a rig on the device: where a shadow ray goes, and what comes back along it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.render.environment_maps import BRIGHTEST
from appearance.scene.hair_scene import SCALE, light_arrays
from appearance.scene.opaque import opaque, opaque_index, opaque_matrix
from reconstruction import Light
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array
from reconstruction.geometry.light_profiles import POLAR_FRAMES, LightProfile


@dataclass(frozen=True)
class PackedLights:
    """Lights in scene units, an array of one number after the other for each property.

    `positions`, `intensities (3 L,)` are there always. `orientations (9 L,)`, `radii (L,)`,
    `sizes (2 L,)` are there where some light has one; a light without a size has sizes of 0.
    `profiles` are the distinct ones, `profile_of (L,)` counts them from 1, 0 for none.
    """

    count: int
    positions: Any
    intensities: Any
    orientations: Any | None = None
    radii: Any | None = None
    sizes: Any | None = None
    profiles: tuple[ProfileTable, ...] = ()
    profile_of: Any | None = None

    @classmethod
    def of(cls, lights: Sequence[Light], weights: ArrayLike = 1.0) -> PackedLights:
        """The bank of `lights`, their intensities times `weights`, which broadcast to `(L, 3)`.

        Raises `ValueError` for a light above `BRIGHTEST` W/sr.
        """
        strength = np.array([x.intensity for x in lights]) * np.asarray(weights, float)
        for light, watts in zip(lights, strength, strict=True):
            if not np.abs(watts).max() <= BRIGHTEST:
                raise ValueError(
                    f"{light.name}: {watts} W/sr cannot be rendered, {BRIGHTEST:g} is the most"
                )
        position, intensity = light_arrays(lights)
        intensity = (intensity * np.asarray(weights, float)).astype(np.float32)
        aims = [np.eye(3) if x.orientation is None else x.orientation for x in lights]
        sizes = np.array([(0.0, 0.0) if x.size is None else x.size for x in lights]) * SCALE
        radii = np.array([x.radius for x in lights]) * SCALE
        profiles = list(
            {id(x.profile): x.profile for x in lights if x.profile is not None}.values()
        )
        numbers = [0 if x.profile is None else 1 + profiles.index(x.profile) for x in lights]
        directed = bool(profiles) or sizes.any()
        return cls(
            len(lights),
            _floats(position),
            _floats(intensity),
            _floats(np.array(aims)) if directed else None,
            _floats(radii) if radii.any() else None,
            _floats(sizes) if sizes.any() else None,
            tuple(ProfileTable.of(p) for p in profiles),
            mi.UInt32(for_kernels(numbers, np.uint32)) if profiles else None,
        )

    def sample(self, light: Any, p: Any, rng: Any, active: Any) -> tuple[Any, Any]:
        """A point of light number `light` to cast a shadow ray at from `p`, and an intensity.

        The intensity over the squared distance to that point is, in the mean over `rng`, the
        light's irradiance across the ray: spheres are sampled uniformly in the solid angle that
        they fill, rectangles uniformly in area. Point lights draw no random numbers.
        """
        centre = dr.gather(mi.Point3f, self.positions, light, active)
        intensity: Any = dr.gather(mi.Color3f, self.intensities, light, active)
        target = centre
        u = v = mi.Float(0)
        if self.radii is not None or self.sizes is not None:
            u, v = rng.next_float32(), rng.next_float32()
        if self.radii is not None:
            radius = dr.gather(mi.Float, self.radii, light, active)
            target, gain = _point_on_sphere(centre, radius, p, u, v)
            intensity = intensity * gain
        if self.orientations is None:
            return target, intensity
        frame: Any = dr.gather(mi.Matrix3f, self.orientations, light, active)
        flat: Any = mi.Bool(False)
        if self.sizes is not None:
            size = dr.gather(mi.Vector2f, self.sizes, light, active)
            flat = size.x > 0
            across = mi.Vector3f(size.x * (u - 0.5), size.y * (v - 0.5), 0)
            target = target + frame.T @ across
        # a rectangle shines from each of its points, all others from their middle
        away = p - (target if self.radii is None else dr.select(flat, target, centre))
        local = frame @ away
        share: Any = mi.Float(1)
        if self.sizes is not None:
            ahead = dr.maximum(local.z, 0) * dr.rsqrt(dr.squared_norm(local))
            share = dr.select(flat, ahead, 1)
        if self.profile_of is not None:
            which = dr.gather(mi.UInt32, self.profile_of, light, active)
            for number, table in enumerate(self.profiles, 1):
                shines = dr.select(flat & (local.z <= 0), 0, table.at(local))
                share = dr.select(which == number, shines, share)
        return target, intensity * share


def _point_on_sphere(centre: Any, radius: Any, p: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """A point uniform in the solid angle that a sphere fills, and its gain on the intensity.

    A sphere of radiance I/(pi r²) fills 2 pi (1 - cos a) with sin a = r/d; the irradiance
    2 I/(d² (1 + cos a)) is that of a point light for r = 0. All is written so that r = 0 is no
    special case, nor its derivative.
    """
    to_centre = centre - p
    squared = dr.squared_norm(to_centre)
    distance = dr.sqrt(squared)
    ratio = dr.minimum(radius / distance, 0.999)
    part = dr.rcp(1 + dr.sqrt(1 - ratio * ratio))  # of 1 - cos a = ratio² part
    u = dr.maximum(u, 1e-7)
    off = u * part * (2 - u * part * ratio * ratio)  # sin² of the angle to the axis, over ratio²
    sine = ratio * dr.sqrt(off)
    cosine = 1 - u * part * ratio * ratio
    s, c = dr.sincos(dr.two_pi * v)
    local = mi.Vector3f(c * sine, s * sine, cosine)
    reach = distance * cosine - ratio * distance * dr.safe_sqrt(1 - off)
    direction = mi.Frame3f(to_centre / distance).to_world(local)
    return p + reach * direction, 2 * part * (reach * reach) / squared


@dataclass(frozen=True)
class ProfileTable:
    """A `LightProfile` on the device; `at` is its `at`."""

    longitudes: Any
    colatitudes: Any
    values: Any
    frame: Array
    shape: tuple[int, int]
    start: Any
    spare: Any

    @classmethod
    def of(cls, profile: LightProfile) -> ProfileTable:
        """The table of `profile`."""
        longitude = profile.longitude_deg
        start, spare = opaque([longitude[0], 0.5 * (360 - (longitude[-1] - longitude[0]))])
        return cls(
            _floats(longitude),
            _floats(profile.colatitude_deg),
            _floats(profile.values),
            POLAR_FRAMES[profile.photometry],
            (len(longitude), len(profile.colatitude_deg)),
            start,
            spare,
        )

    def at(self, direction: Any) -> Any:
        """The profile's value `Float` towards `direction` in the light's frame."""
        polar = opaque_matrix(self.frame) @ direction
        squared = polar.x * polar.x + polar.y * polar.y
        on_axis = squared == 0  # where the angles have no derivative
        sine = dr.select(on_axis, 0, dr.sqrt(dr.select(on_axis, 1, squared)))
        colatitude = dr.rad2deg(dr.atan2(sine, polar.z))
        longitude = dr.rad2deg(dr.atan2(polar.y, dr.select(on_axis, 1, polar.x)))
        turn = (longitude - self.start + self.spare) * (1 / 360)
        longitude = (turn - dr.floor(turn)) * 360 - self.spare + self.start
        i, a, lit_i = _interval(self.longitudes, self.shape[0], longitude)
        j, b, lit_j = _interval(self.colatitudes, self.shape[1], colatitude)
        index = i * opaque_index(self.shape[1]) + j
        lit = lit_i & lit_j
        corner = [
            dr.gather(mi.Float, self.values, index + k, lit)
            for k in (0, 1, self.shape[1], self.shape[1] + 1)
        ]
        low, high = dr.lerp(corner[0], corner[1], b), dr.lerp(corner[2], corner[3], b)
        return dr.select(lit, dr.lerp(low, high, a), 0)


_SLACK_DEG = 1e-4  # a direction on a table's last node is in it, however it was rounded


def _interval(nodes: Any, count: int, x: Any) -> tuple[Any, Any, Any]:
    """Left node of the interval that holds `x`, the share of the way through it, and if it does."""
    here = dr.detach(x)
    search: Any = dr.binary_search  # untyped
    beyond = search(1, count - 1, lambda k: dr.gather(mi.Float, nodes, k) <= here)
    i = mi.UInt32(beyond) - 1
    low, high = dr.gather(mi.Float, nodes, i), dr.gather(mi.Float, nodes, i + 1)
    inside = (here >= dr.gather(mi.Float, nodes, 0) - _SLACK_DEG) & (
        here <= dr.gather(mi.Float, nodes, count - 1) + _SLACK_DEG
    )
    return i, dr.clip((x - low) / (high - low), 0, 1), inside


def _floats(values: ArrayLike) -> Any:
    return mi.Float(for_kernels(np.ravel(values)))
