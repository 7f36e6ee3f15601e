"""A fit's data, and the error of a guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.inverse_rendering import losses
from appearance.inverse_rendering.batches import Batch, Comparison, Patch
from appearance.inverse_rendering.linearised import LinearisedPictures
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.unknowns import Raw, decode
from appearance.metrics.scores import srgb
from appearance.observations import Observed
from appearance.render.cached_paths import CachedPaths, CachedSampling, WeightedPixels, cache_paths
from appearance.render.olat import render_indirect, render_olat
from appearance.render.smoothed import olat_smoothed
from appearance.render.tracing import Sampling
from appearance.scene.hair_scene import SCALE, HairScene, light_arrays
from appearance.sun_fit.visible_fibres import visible_fibres
from reconstruction import Camera
from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.geometry.lights import Lighting, components

_DIRECT_PATHS, _FEWEST, _MOST = 400_000, 4, 16
"""Cached one-vertex paths of all views, and fewest and most per pixel."""
_ALL = 1e-9
"""Dimmest light that casts shadow rays, so low that the choice does not depend on the hair."""
_LEAST_SPP = 16
"""Least paths a pixel of indirect light."""
_WHOLE_PATHS, _LEAST_PATHS, _PARTS = 1 << 17, 4, 9
"""Paths of full images of all views, least paths a pixel, and parts of a view's hair."""
_FIRST_LIGHTS, _DEEP_LIGHTS = 8, 3
"""Lights sampled at a path's first and later vertices, for means over lights."""


@dataclass(frozen=True, eq=False)
class DirectLight:
    """Cached one-vertex paths of a `patch`: its direct light for any maps.

    `intensities (L, 3)` of the patch's single lights are in scene units, times the exposure.
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


def judging_spp(pixels: int, effort: Effort) -> int:
    """Paths a pixel of frames that decide, for views of so many `pixels` in total."""
    return int(np.clip(_WHOLE_PATHS // max(2 * pixels, 1), _LEAST_PATHS, effort.spp))


class FitProblem:
    """Hair pixels of `views` under `lights`, the geometry, and the exposure `scale`.

    All views have the same lights; `skin (3,)`. Rendered and captured values are in exposure units
    here. A guess is its unconstrained numbers `raw` and the lights' factors `gain (L,)`.
    """

    def __init__(
        self, mapped: MappedStrands, views: Sequence[Observed], scale: float, skin: Array
    ) -> None:
        self.mapped, self.views, self.scale, self.skin = mapped, tuple(views), scale, skin
        self.lights: tuple[Lighting, ...] = views[0].lights if views else ()
        self._scenes: list[HairScene] = []
        self._level = [
            losses.level(o.radiance.astype(float) * scale).astype(np.float32) for o in self.views
        ]

    def patch(self, batch: Batch, pixels: int, rng: np.random.Generator) -> Patch:
        """At most `pixels` random ones of a batch's view, in the order of the image."""
        few = np.sort(rng.permutation(len(self.views[batch.view].pixels))[:pixels])
        return Patch(batch.view, batch.lights, few)

    def part(self, views: Ints, lights: Ints) -> FitProblem:
        """Some of the views under some of the lights, by their numbers; the scene is shared."""
        few = [self.views[k].under(lights) for k in views]
        out = FitProblem(self.mapped, few, self.scale, self.skin)
        out._scenes = self._scenes
        return out

    def under(self, lights: Sequence[Lighting]) -> FitProblem:
        """The same under other `lights` (L), at the same places; the scene is shared."""
        views = [replace(o, lights=tuple(lights)) for o in self.views]
        out = FitProblem(self.mapped, views, self.scale, self.skin)
        out._scenes = self._scenes
        return out

    @cached_property
    def centre(self) -> Array:
        """The middle `(3,)` of what is rendered, in metres."""
        return np.array(self.mapped.scene.mi_scene.bbox().center()).ravel() / SCALE

    def points(self, patch: Patch) -> Array:
        """The mean hit `(P, 3)` of each pixel of a patch, in metres; `centre` without one."""
        o = self.views[patch.view]
        fibres = visible_fibres(self.mapped.scene, o.camera, o.pixels[patch.few])
        count = fibres.hair.sum(axis=1)[:, None]
        mean = fibres.point.sum(axis=1, dtype=float) / np.maximum(count, 1)
        return np.where(count > 0, mean, self.centre)

    def squares(
        self, raw: Raw, gain: Array, used: Bools, effort: Effort, seed: int
    ) -> tuple[Array, Array]:
        """Sums of squared errors of displayed (sRGB) values, and their counts `(V, B)`.

        Of all hair pixels of the V views of the pairs `used (V', L)`: products of the errors of two
        independent images. Indirect light is smoothed (`olat_smoothed`), as the curve would make
        its noise an error; smoothing and the rest of the noise leave a root mean square of 0.03 to
        0.05 on hair ten pixels wide. The B parts are a view's pixels, with own paths, in image
        order.
        """
        views = [k for k in range(len(self.views)) if used[k].any()]
        spp = judging_spp(sum(len(self.views[k].pixels) for k in views), effort)
        sums, counts = [], []
        for k in views:
            o, lights = self.views[k], np.flatnonzero(used[k])
            patch = Patch(k, lights, np.arange(len(o.pixels)))
            scene, camera, lit, pixels = self._setup(raw, gain, patch)
            captured = srgb(o.radiance[lights].astype(float) * self.scale)
            squares = np.where(o.valid[lights][..., None], 1.0, np.zeros(3))
            counts.append(_parts(squares.sum(axis=(0, 2))))
            for h in (0, 1):
                sampling = Sampling(spp, effort.max_depth, seed + k + (h << 20))
                image = olat_smoothed(scene, camera, lit, sampling, pixels=pixels)
                squares *= srgb(image * self.scale) - captured
            sums.append(_parts(squares.sum(axis=(0, 2))))
        return np.stack(sums), np.stack(counts)

    def compare(self, patch: Patch, rendered: Array) -> Comparison:
        """`rendered (k, P, 3)` beside what was captured of a patch, `(P,)` pixels."""
        o = self.views[patch.view]
        captured = o.radiance[patch.lights][:, patch.few].astype(float) * self.scale
        level = self._level[patch.view][patch.lights][:, patch.few].astype(float)
        # weights at the middle of both make squares those of displayed differences, large ones too
        level = 0.5 * (level + losses.level(rendered))
        return Comparison(rendered, captured, level, o.valid[patch.lights][:, patch.few])

    def render(
        self, raw: Raw, gain: Array, patch: Patch, effort: Effort, seed: int, thrift: float = 0
    ) -> Array:
        """A patch under `gain (L,)` in exposure units `(k, P, 3)`; see `OlatOptions.thrift`."""
        scene, camera, lights, pixels = self._setup(raw, gain, patch)
        options = {"spp": effort.spp, "max_depth": effort.max_depth, "thrift": thrift}
        radiance = render_olat(scene, camera, lights, seed=seed, pixels=pixels, **options)
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
        intensities = light_arrays(components(lights)[0])[1] * self.scale
        return LinearisedPictures(paths, self.mapped, decode(raw), intensities)

    def direct(self, raw: Raw, gain: Array, patch: Patch, effort: Effort, seed: int) -> DirectLight:
        """Paths of one vertex through a patch under `gain (L,)`, a shadow ray to every light."""
        scene, camera, lights, pixels = self._setup(raw, gain, patch)
        wanted = WeightedPixels(pixels, np.ones((len(lights), len(pixels)), np.float32))
        sampling = CachedSampling(effort.spp, 1, _ALL)
        paths = cache_paths(scene, camera, lights, wanted, sampling, seed)
        intensities = light_arrays(components(lights)[0])[1] * self.scale
        return DirectLight(self.mapped, patch, paths, intensities)

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
        if not self._scenes:
            self._scenes.append(self.mapped.with_maps(maps).with_skin(self.skin))
        self._scenes[0] = self.mapped.update_maps(self._scenes[0], maps)
        return self._scenes[0]

    def _setup(
        self, raw: Raw, gain: Array, patch: Patch
    ) -> tuple[HairScene, Camera, list[Lighting], Ints]:
        """Scene, camera, lights and pixels of a patch, as `raw` and `gain (L,)` have them."""
        o = self.views[patch.view]
        lights = [self.lights[i].scaled(float(gain[i])) for i in patch.lights]
        return self._scene_of(raw), o.camera, lights, o.pixels[patch.few]


def _parts(values: AnyFloats) -> Array:
    """Sums over `_PARTS` parts of the pixels of `values (…, P)`: `(…, B)`."""
    return np.stack([x.sum(-1) for x in np.array_split(values, _PARTS, axis=-1)], axis=-1)
