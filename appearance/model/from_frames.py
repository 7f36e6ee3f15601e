"""A captured subject relit from its frames: captured cameras under new lights, and new views.

Roots of radiance are interpolated and compared: their noise is nearly even, and so is the error
that is visible.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from appearance.fields.interpolation import FLOOR, irradiance, weighted
from appearance.fields.neighbours import kriging_weights
from appearance.fields.reflectance import CapturedView, ReflectanceField, gather
from appearance.model.baselines import first_hits
from appearance.model.fitted_model import FittedModel
from appearance.model.light_sums import weights_of_environment
from appearance.observations import far_apart
from appearance.render.coverage import FUZZ, coverage
from appearance.render.mixed import Environment
from appearance.render.olat import render_olat
from appearance.scene.hair_scene import HairScene
from reconstruction import Camera, Capture, CaptureError, Light, Model, ModelError, Progress, silent
from reconstruction.arrays import AnyFloats, Array, Bools, Floats

Rendered = Mapping[str, AnyFloats]
"""The model's images of the captured cameras."""
GUIDE = 4
"""Paths a pixel of the guide's images, which are blurred."""
EXTENT = 12.0
"""The hair's extent (the root of its area) over the guide's blur."""
SCALES = (1, 2, 4, 8, 16)
"""Blurs of the regressors, in captured pixels."""
COUNT = 4 + 2 * len(SCALES)
"""Of the regressors."""
EDGE = 0.05
"""Share of hair in a pixel from which it is relit: edges of the model are too thin."""
WIDE = np.radians(100)
"""Angle between cameras beyond which they share no visible hair."""
MOST_EXPOSURE = 2.5
"""Factor between the 99th percentiles of frames of the same hair, of all and of fewer lights."""
_DARK = 1e-12
"""W/m² of a dark light."""
_RIDGE = 1e-5
"""Of the regression, relative to the mean square of the regressors."""
_LEAST = 0.05
"""Weight of visible places at which half of a difference is applied."""


@dataclass(frozen=True, eq=False)
class _Surface:
    """The model's first hits `points (H, W, 3)` in a view, and its coverage by hair `(H, W)`."""

    camera: Camera
    points: Array
    hair: Floats

    @classmethod
    def of(cls, scene: HairScene, camera: Camera) -> _Surface:
        points, met = first_hits(scene, camera, np.ones((camera.height, camera.width), bool))
        if not met.any():
            raise ValueError(f"{camera.name}: the model has no hair in this view")
        return cls(camera, points, coverage(scene, camera)["hair"])

    @cached_property
    def distance(self) -> Floats:
        """Of the points from the camera `(H, W)`, metres."""
        away = np.linalg.norm(self.points - self.camera.center, axis=-1)
        return np.asarray(away, np.float32)

    @property
    def footprint(self) -> float:
        """The width of a pixel at the hair, metres."""
        return float(np.median(self.distance) / self.camera.K[0, 0])


@dataclass(frozen=True, eq=False)
class _Image:
    """Roots of radiance `(H, W, 3)` of a view by the model, and `captured` where `known (H, W)`."""

    at: _Surface
    root: Floats
    captured: Floats
    known: Bools


@dataclass(frozen=True, eq=False)
class FromFrames:
    """The frames of a capture on its model. `field` has their samples, under the model's lights."""

    fitted: FittedModel
    scene: HairScene
    field: ReflectanceField

    @classmethod
    def of(
        cls,
        fitted: FittedModel,
        model: Model,
        capture: Capture,
        *,
        folder: Path | None = None,
        progress: Progress = silent,
    ) -> FromFrames:
        """Read the frames at the cameras' hair masks; `folder` as in `gather`.

        Raises `CaptureError` for a capture without frames under single lights or of another
        exposure than the model's, `ModelError` if no camera shows hair.
        """
        if not capture.olat_lights():
            raise CaptureError(
                f"{capture.path}: it has no frames under single lights: capture some, or render "
                "the model alone"
            )
        masks = {
            c.name: np.flatnonzero(model.mask(c.name, "hair", capture)) for c in capture.rig.cameras
        }
        scale = fitted.appearance.exposure.scale
        field = gather(capture, masks, scale, folder=folder, progress=progress)
        if not field.views:
            raise ModelError(f"{model}: the hair masks of the cameras are all empty")
        values = np.concatenate([v.table[:: -(-len(v.table) // 16)].ravel() for v in field.views])
        white = float(np.nanpercentile(values.astype(np.float32), 99))
        if not 1 / MOST_EXPOSURE < white < MOST_EXPOSURE:
            raise CaptureError(
                f"{capture.path}: its hair is {white:.2g} times as bright as that which {model} "
                "was fitted to: give the capture that the model was made of"
            )
        lights = tuple(fitted.lights([x.name for x in field.lights]))
        return cls(fitted, fitted.scene(), replace(field, lights=lights))

    @property
    def middle(self) -> Array:
        """The hair's centre `(3,)`, from which directions are compared."""
        return np.asarray(self.fitted.strands.points.mean(axis=0), float)

    def view(self, camera: Camera) -> CapturedView | None:
        """The captured view of `camera`, if there is one."""
        known = camera.to_dict()
        return next((v for v in self.field.views if v.camera.to_dict() == known), None)

    def lights_of(self, environments: Sequence[Environment]) -> list[Light]:
        """Environments as lights of the capture, at the power of the map around each."""
        lights = self.field.lights
        out = []
        for e in environments:
            shares = weights_of_environment(lights, e.envmap, e.rotation_deg)
            shares = shares * np.asarray(e.weight, float)
            for light, share in zip(lights, shares, strict=True):
                if share.any():
                    out.append(replace(light, intensity=light.intensity * share))
        return out

    def some_lights(self, most: int = 6) -> list[Light]:
        """At most `most` captured lights far apart, for `NewViews` of single lights."""
        lights = self.field.lights
        return [lights[k] for k in far_apart(np.array([x.position for x in lights]), most)]

    def relit(
        self, view: CapturedView, lights: Sequence[Light], base: AnyFloats
    ) -> tuple[Floats, float]:
        """The image `base (H, W, 3)` of the model, its hair from a view's frames under `lights`.

        Also the share of the hair that all frames near a light saturate: it stays the model's.
        """
        image, found = np.array(base, np.float32), self.captured_view(view, lights)
        known = np.isfinite(found).all(axis=-1)
        image.reshape(-1, 3)[view.pixels[known]] = found[known]
        return image, float(1 - known.mean())

    def captured_view(self, view: CapturedView, lights: Sequence[Light]) -> Floats:
        """Radiance `(P, 3)` of a captured view's pixels under `lights`, NaN where saturated.

        Ordinary kriging of the roots of frames over irradiance, each times the ratio of the model's
        blurred images under the new and the captured light, which `FLOOR` bounds.
        """
        directions, new = (
            _unit(np.array([x.position for x in many]).reshape(-1, 3) - self.middle)
            for many in (self.field.lights, lights)
        )
        there = np.flatnonzero([np.isfinite(view.table[k]).any() for k in range(len(directions))])
        if not len(there):
            raise ModelError(f"{view.camera.name}: all of its frames are missing or saturated")
        total = np.zeros((len(view.pixels), 3), np.float32)
        for light, towards in zip(lights, new, strict=True):
            near, weights = kriging_weights(directions[there], towards)
            near = there[near]
            lit = [self.field.lights[k] for k in near]
            given = self._irradiances(lit)
            unknown = np.full((len(near), *total.shape), np.nan, np.float32)
            samples = np.divide(view.under(near), given, out=unknown, where=given > _DARK)
            root = np.sqrt(np.maximum(samples, 0))
            if len(near) > 1:
                guide = self._guide(view, [*lit, light])
                root *= np.sqrt(guide[-1] / guide[:-1])
            known = np.asarray(np.isfinite(root).all(axis=(0, 2)))
            positive = weighted(root, np.maximum(weights, 0))
            root = np.where(known[:, None], weighted(root, weights), positive)
            total += np.maximum(root, 0) ** 2 * self._irradiances([light])[0]
        return total / np.float32(self.field.scale)

    def _irradiances(self, lights: Sequence[Light]) -> Floats:
        """Of each light at the hair's centre `(L, 1, 3)`."""
        at = self.middle.astype(np.float32)[None]
        return np.stack([irradiance(x, at) for x in lights])

    def _guide(self, view: CapturedView, lights: Sequence[Light]) -> Floats:
        """The model's blurred images over irradiance, at a view's pixels `(L, P, 3)`."""
        size, sigma = (view.camera.height, view.camera.width), np.sqrt(len(view.pixels)) / EXTENT
        lit = render_olat(self.scene, view.camera, lights, spp=GUIDE, pixels=view.pixels)
        mask = np.zeros(size, np.float32)
        mask.reshape(-1)[view.pixels] = 1
        out = np.empty_like(lit)
        for k, values in enumerate(lit):
            image = np.zeros((*size, 3), np.float32)
            image.reshape(-1, 3)[view.pixels] = values
            out[k] = _mean(image, mask, sigma).reshape(-1, 3)[view.pixels]
        out /= np.maximum(self._irradiances(lights), _DARK)
        return out + np.float32(FLOOR * out.mean() + _DARK)

    def root(self, radiance: AnyFloats) -> Floats:
        """Of radiance in exposure units."""
        return np.asarray(np.sqrt(np.maximum(radiance, 0) * self.field.scale), np.float32)


@dataclass(frozen=True, eq=False)
class NewViews:
    """New views of relit frames, under one of several lightings.

    The roots of the captured cameras' images are the model's and a linear function of `_regressors`
    with `factors (N,)`, which are fitted by leaving out each camera in turn. `sources` are these
    images by lighting, `unit` the width of their pixels at the hair.
    """

    frames: FromFrames
    sources: Sequence[Sequence[_Image]]
    unit: float
    factors: Floats

    @classmethod
    def of(
        cls, frames: FromFrames, lightings: Sequence[Sequence[Light]], rendered: Rendered
    ) -> NewViews:
        """Relight the frames under each of `lightings` and fit the factors to all of them.

        `rendered` by camera are the model's images `(len(lightings), H, W, 3)`. Raises `ValueError`
        for fewer than two cameras with hair.
        """
        views = frames.field.views
        if len(views) < 2:
            raise ValueError(
                f"a new view needs frames of two cameras, there are those of {len(views)}: choose "
                "a captured camera, or render the model alone"
            )
        places = [_Surface.of(frames.scene, v.camera) for v in views]
        sources: list[list[_Image]] = []
        for k, lights in enumerate(lightings):
            sources.append([])
            for view, place in zip(views, places, strict=True):
                root = frames.root(rendered[view.camera.name][k])
                captured, known = root.copy(), np.zeros(root.shape[:2], bool)
                found = frames.captured_view(view, lights)
                good = np.isfinite(found).all(axis=-1)
                captured.reshape(-1, 3)[view.pixels[good]] = frames.root(found[good])
                known.reshape(-1)[view.pixels[good]] = True
                sources[k].append(_Image(place, root, captured, known))
        unit = float(np.median([place.footprint for place in places]))
        gram, moment = np.zeros((COUNT, COUNT)), np.zeros(COUNT)
        for images in sources:
            for one in images:
                others = [i for i in images if i is not one]
                x, _ = _regressors(one.at, one.root, others, frames.middle, unit)
                missing = (one.captured - one.root)[one.known].ravel().astype(float)
                x = x[one.known].reshape(-1, COUNT).astype(float)
                gram += x.T @ x / max(len(x), 1)
                moment += x.T @ missing / max(len(x), 1)
        ridge = _RIDGE * np.trace(gram) / COUNT + 1e-30
        factors = np.linalg.solve(gram + ridge * np.eye(COUNT), moment)
        return cls(frames, sources, unit, factors.astype(np.float32))

    def __call__(self, camera: Camera, base: AnyFloats, lighting: int = 0) -> tuple[Floats, float]:
        """The model's image `base (H, W, 3)` of `camera` with what the frames add to its hair.

        Also the share of the hair that no camera captured, where the model remains. Raises
        `ValueError` if that is all.
        """
        at, root = _Surface.of(self.frames.scene, camera), self.frames.root(base)
        sources = self.sources[lighting]
        made, seen = _regressors(at, root, sources, self.frames.middle, self.unit)
        hair = at.hair > EDGE
        if not (seen[hair] > 0).any():
            raise ValueError(
                f"{camera.name}: no captured camera sees the hair of this view: choose a view "
                "nearer to them, or render the model alone"
            )
        image = np.array(base, np.float32)
        found = root[hair] + made[hair] @ self.factors
        image[hair] = np.maximum(found, 0) ** 2 / np.float32(self.frames.field.scale)
        return image, float((seen[hair] == 0).mean())


def _regressors(
    target: _Surface, root: Floats, sources: Sequence[_Image], middle: Array, unit: float
) -> tuple[Floats, Floats]:
    """What may be missing in the model's `root (H, W, 3)`, and where sources see it `(H, W)`.

    `(H, W, 3, COUNT)`: a constant, the model's image and its blurs, what the frames of `sources`
    show at the same places, the model's images of these, and blurred differences of both. A
    source's weight falls with the angle between the cameras, and where the model's first hit is
    more than `FUZZ` nearer.
    """
    shape = target.hair.shape
    weight = np.zeros(shape, np.float32)
    captured, rendered = (np.zeros((*shape, 3), np.float32) for _ in range(2))
    own = _unit(target.camera.center[None] - middle)[0]
    towards = _unit(np.array([s.at.camera.center for s in sources]).reshape(-1, 3) - middle)
    angles = np.arccos(np.clip(towards @ own, -1, 1)).tolist()
    nearest = max(min(angles, default=1.0), 1e-3)
    for source, angle in zip(sources, angles, strict=True):
        if angle > WIDE:
            continue
        pixel, depth = source.at.camera.project(target.points.reshape(-1, 3))
        inside = ((depth > 0) & source.at.camera.inside(pixel)).reshape(shape)
        x, y = np.moveaxis(np.where(inside[..., None], pixel.reshape(*shape, 2), -9), -1, 0)

        def at(image: AnyFloats | Bools, x: Array = x, y: Array = y) -> Floats:
            where = x.astype(np.float32), y.astype(np.float32)
            found = cv2.remap(np.asarray(image, np.float32), *where, cv2.INTER_LINEAR)
            return np.asarray(found, np.float32)

        behind = np.linalg.norm(target.points - source.at.camera.center, axis=-1) - at(
            source.at.distance
        )
        share = inside * np.clip(1.5 - behind / (2 * FUZZ), 0, 1) * at(source.known)
        share = (share * np.exp(1 - angle / nearest)).astype(np.float32)
        weight += share
        captured += share[..., None] * at(source.captured)
        rendered += share[..., None] * at(source.root)
    scale = np.divide(1, weight, out=np.zeros_like(weight), where=weight > 0)[..., None]
    captured, rendered = captured * scale, rendered * scale
    out = [np.ones_like(captured), root, captured, rendered]
    for factor in SCALES:
        sigma = factor * unit / target.footprint
        near = cv2.GaussianBlur(weight, (0, 0), sigma)
        near = near / (near + _LEAST)
        out.append(_mean(root, target.hair, sigma))
        out.append(_mean(captured - rendered, weight, sigma) * near[..., None])
    return np.stack(out, axis=-1), weight


def _mean(image: Floats, weight: Floats, sigma: float) -> Floats:
    """The Gaussian mean of an image `(H, W, 3)` by `weight (H, W)`, 0 far from any."""
    total = cv2.GaussianBlur(weight, (0, 0), sigma)[..., None]
    mixed = cv2.GaussianBlur(image * weight[..., None], (0, 0), sigma)
    return np.divide(mixed, total, out=np.zeros_like(mixed), where=total > 1e-6)


def _unit(vectors: AnyFloats) -> Array:
    length = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return np.asarray(vectors / length, float)
