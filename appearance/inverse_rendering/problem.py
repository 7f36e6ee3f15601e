"""A fit's data, and the error of a guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.inverse_rendering import losses
from appearance.inverse_rendering.batches import Batch, Comparison, Patch
from appearance.inverse_rendering.linearised import LinearisedPictures
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.unknowns import Raw, decode
from appearance.observations import Observed
from appearance.render.cached_paths import CachedPaths, CachedSampling, WeightedPixels, cache_paths
from appearance.render.olat import render_indirect, render_olat
from appearance.scene.hair_scene import HairScene, light_arrays
from reconstruction import Camera, Light
from reconstruction.arrays import AnyFloats, Array, Bools, Ints

ValidationSet = Sequence[tuple[Patch, Array]]
"""Patches, and the share `(k, P, 3)` of its weight that each value keeps."""

_DIRECT_PATHS, _FEWEST, _MOST = 400_000, 4, 16
"""Cached one-vertex paths of all views, and fewest and most per pixel."""
_ALL = 1e-9
"""Dimmest light that casts shadow rays, so low that the choice does not depend on the hair."""
_LEAST_SPP = 16
"""Least paths a pixel of indirect light."""
_WHOLE_PATHS, _LEAST_PATHS, _PARTS = 1 << 20, 4, 9
"""Paths of full images of all views, least paths a pixel, and about how many parts of the hair."""
_FIRST_LIGHTS, _DEEP_LIGHTS = 8, 3
"""Lights sampled at a path's first and later vertices, for means over lights."""


@dataclass(frozen=True, eq=False)
class DirectLight:
    """Cached one-vertex paths of a `patch`: its direct light for any maps.

    `intensities (L, 3)` of the patch's lights are in scene units, times the exposure.
    """

    mapped: MappedStrands
    patch: Patch
    paths: CachedPaths
    intensities: AnyFloats

    def linearised(self, maps: HairMaps, names: Sequence[str]) -> LinearisedPictures:
        """With `maps` on the hair, and derivatives by `names`, in exposure units."""
        return LinearisedPictures(self.paths, self.mapped, maps, self.intensities, names)


def direct_spp(pixels: int) -> int:
    """Cached one-vertex paths a pixel, for views of so many `pixels` in total."""
    return int(np.clip(_DIRECT_PATHS // max(pixels, 1), _FEWEST, _MOST))


class FitProblem:
    """Hair pixels of `views` under `lights`, the geometry, and the exposure `scale`.

    All views have the same lights; `skin (3,)`. Rendered and captured values are in exposure units
    here. A guess is its unconstrained numbers `raw` and the lights' factors `gain (L,)`.
    """

    def __init__(
        self, mapped: MappedStrands, views: Sequence[Observed], scale: float, skin: Array
    ) -> None:
        self.mapped, self.views, self.scale, self.skin = mapped, tuple(views), scale, skin
        self.lights: tuple[Light, ...] = views[0].lights if views else ()
        self._scene: HairScene | None = None
        self._level = [
            losses.level(o.radiance.astype(float) * scale).astype(np.float32) for o in self.views
        ]

    def patch(self, batch: Batch, pixels: int, rng: np.random.Generator) -> Patch:
        """At most `pixels` random ones of a batch's view, in the order of the image."""
        few = np.sort(rng.permutation(len(self.views[batch.view].pixels))[:pixels])
        return Patch(batch.view, batch.lights, few)

    def error(
        self, raw: Raw, gain: Array, validation: ValidationSet, effort: Effort, seed: int
    ) -> float:
        """Weighted mean squared difference, noise taken off, at `gain (L,)`, of fixed seeds."""
        values = []
        for patch, share in validation:
            a, b = self._twice(raw, gain, patch, effort, seed)
            one, other = (x.rendered - x.captured for x in (a, b))
            weight = share * losses.weights(0.5 * (a.level + b.level))
            values.append(losses.squares(one, other, weight, a.valid))
        return float(np.mean(values)) if values else 0.0

    def full_image_errors(
        self, guesses: Sequence[tuple[Raw, Array]], used: Bools, effort: Effort, seed: int
    ) -> Array:
        """The errors of full images by part of the hair, of each guess `(G, B)`.

        Their mean over B is the weighted mean squared difference, without noise, of all hair pixels
        of the pairs `used (V, L)`, with the same weights for all guesses. A part is a ninth of a
        view's pixels under all its lights, with own paths.
        """
        views = [k for k in range(len(self.views)) if used[k].any()]
        paths = _WHOLE_PATHS // (2 * sum(len(self.views[k].pixels) for k in views))
        spent = {
            "spp": int(np.clip(paths, _LEAST_PATHS, 2 * effort.spp)),
            "max_depth": effort.max_depth,
        }
        parts, counted = [], 0
        for k in views:
            o, lights = self.views[k], np.flatnonzero(used[k])
            patch = Patch(k, lights, np.arange(len(o.pixels)))
            halves = np.zeros((len(guesses), 2, len(lights), len(o.pixels), 3))
            for g, (raw, gain) in enumerate(guesses):
                scene, camera, packed, pixels = self._setup(raw, gain, patch)
                for h in (0, 1):
                    first = seed + k + (h << 20)
                    halves[g, h] = render_olat(
                        scene, camera, packed, seed=first, pixels=pixels, **spent
                    )
            halves *= self.scale
            rendered = losses.level(halves.mean(axis=(0, 1)))
            weight = losses.weights(0.5 * (self._level[k][lights] + rendered))
            product = (halves - o.radiance[lights] * self.scale).prod(axis=1)
            squares = (product * weight * o.valid[lights][..., None]).sum(axis=(1, 3))
            slices = np.array_split(squares, min(_PARTS, len(o.pixels)), axis=1)
            parts += [x.sum(axis=1) for x in slices]
            counted += 3 * int(o.valid[lights].sum())
        return np.array(parts).T * (len(parts) / max(counted, 1))

    def validation(
        self, raw: Raw, gain: Array, pairs: Sequence[Batch], effort: Effort, seed: int
    ) -> ValidationSet:
        """What `error` observes: pixels of `pairs`, weighted by noise about `raw`, `gain (L,)`."""
        out = []
        for batch in pairs:
            patch = self.patch(batch, effort.pixels, np.random.default_rng(seed))
            a, b = self._twice(raw, gain, patch, effort, seed + (1 << 22))
            weight = np.where(a.valid[..., None], losses.weights(0.5 * (a.level + b.level)), 0)
            kept = losses.noise_weighted(weight, (a.rendered - b.rendered) ** 2)
            share = np.divide(kept, weight, out=np.zeros_like(weight), where=weight > 0)
            out.append((patch, share))
        return out

    def _twice(
        self, raw: Raw, gain: Array, patch: Patch, effort: Effort, seed: int
    ) -> tuple[Comparison, Comparison]:
        """Two independent images beside what was captured."""
        one, other = (self.render(raw, gain, patch, effort, seed + k) for k in (0, 1 << 20))
        return self.compare(patch, one), self.compare(patch, other)

    def compare(self, patch: Patch, rendered: Array) -> Comparison:
        """`rendered (k, P, 3)` beside what was captured of a patch, `(P,)` pixels."""
        o = self.views[patch.view]
        captured = o.radiance[patch.lights][:, patch.few].astype(float) * self.scale
        level = self._level[patch.view][patch.lights][:, patch.few].astype(float)
        # weights at the middle of both make squares those of displayed differences, large ones too
        level = 0.5 * (level + losses.level(rendered))
        return Comparison(rendered, captured, level, o.valid[patch.lights][:, patch.few])

    def render(self, raw: Raw, gain: Array, patch: Patch, effort: Effort, seed: int) -> Array:
        """A patch under `gain (L,)` in exposure units `(k, P, 3)`."""
        scene, camera, lights, pixels = self._setup(raw, gain, patch)
        spent: dict[str, int] = {"spp": effort.spp, "max_depth": effort.max_depth, "thrift": 0}
        radiance = render_olat(scene, camera, lights, seed=seed, pixels=pixels, **spent)
        return radiance.astype(float) * self.scale

    def render_all(self, raw: Raw, gain: Array, view: int, effort: Effort, seed: int) -> Array:
        """All pixels of a view under all lights `(L, P, 3)`, for means over lights: those of single
        lights are noisy, as a path samples few of them."""
        spent = {"first_lights": _FIRST_LIGHTS, "deep_lights": _DEEP_LIGHTS}
        scene, camera, packed, pixels = self._setup(raw, gain, self._whole(view))
        spent |= {"spp": effort.spp, "max_depth": effort.max_depth}
        radiance = render_olat(scene, camera, packed, seed=seed, pixels=pixels, **spent)
        return radiance.astype(float) * self.scale

    def linearised(
        self, raw: Raw, gain: Array, patch: Patch, effort: Effort, seed: int
    ) -> LinearisedPictures:
        """A patch under `gain (L,)` on paths of its own, and its derivatives, in exposure units."""
        scene, camera, lights, pixels = self._setup(raw, gain, patch)
        level = self._level[patch.view][patch.lights][:, patch.few].astype(float)
        # a light's importance is its effect on a displayed image
        importance = self.scale * np.sqrt(losses.weights(level)).mean(axis=-1)
        wanted = WeightedPixels(pixels, importance)
        sampling = CachedSampling(max(2, effort.spp), effort.max_depth)
        paths = cache_paths(scene, camera, lights, wanted, sampling, seed)
        intensities = light_arrays(lights)[1] * self.scale
        return LinearisedPictures(paths, self.mapped, decode(raw), intensities)

    def direct(self, raw: Raw, gain: Array, patch: Patch, effort: Effort, seed: int) -> DirectLight:
        """Paths of one vertex through a patch under `gain (L,)`, a shadow ray to every light."""
        scene, camera, lights, pixels = self._setup(raw, gain, patch)
        wanted = WeightedPixels(pixels, np.ones((len(lights), len(pixels)), np.float32))
        sampling = CachedSampling(effort.spp, 1, _ALL)
        paths = cache_paths(scene, camera, lights, wanted, sampling, seed)
        return DirectLight(self.mapped, patch, paths, light_arrays(lights)[1] * self.scale)

    def indirect(self, raw: Raw, gain: Array, view: int, effort: Effort, seed: int) -> Array:
        """All pixels of a view under all lights `(L, P, 3)`, without the light that reaches the
        first hit directly."""
        scene, camera, lights, pixels = self._setup(raw, gain, self._whole(view))
        spent: dict[str, int] = {
            "spp": max(_LEAST_SPP, effort.spp // 4),
            "max_depth": effort.max_depth,
        }
        rest = render_indirect(scene, camera, lights, pixels, seed=seed, **spent)
        return rest.astype(float) * self.scale

    def _whole(self, view: int) -> Patch:
        """All pixels of a view under all lights."""
        lights, pixels = np.arange(len(self.lights)), np.arange(len(self.views[view].pixels))
        return Patch(view, lights, pixels)

    def spread(self, used: Bools, views: int, images: int) -> list[Batch]:
        """At most `views` and `images` lights of each, evenly over the pairs `used (V, L)`."""
        usable = np.flatnonzero(used.any(axis=1))
        count, out = min(views, len(usable)), []
        for view in usable[[int((i + 0.5) * len(usable) / count) for i in range(count)]]:
            lights = np.flatnonzero(used[view])
            lights = lights[:: max(1, -(-len(lights) // images))]
            out.append(Batch(int(view), lights))
        return out

    def _scene_of(self, raw: Raw) -> HairScene:
        """The one scene of this problem, as `raw` has it."""
        maps = decode(raw)
        if self._scene is None:
            self._scene = self.mapped.with_maps(maps).with_skin(self.skin)
        self._scene = self.mapped.update_maps(self._scene, maps)
        return self._scene

    def _setup(
        self, raw: Raw, gain: Array, patch: Patch
    ) -> tuple[HairScene, Camera, list[Light], Ints]:
        """Scene, camera, lights and pixels of a patch, as `raw` and `gain (L,)` have them."""
        o = self.views[patch.view]
        lights = [
            replace(self.lights[i], intensity=self.lights[i].intensity * gain[i])
            for i in patch.lights
        ]
        return self._scene_of(raw), o.camera, lights, o.pixels[patch.few]
