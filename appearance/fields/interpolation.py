"""Captured frames interpolated on strands: Photobooth's reflectance field (§4)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from appearance.bsdf.maps import MappedStrands
from appearance.fields.hits import HitOptions, Hits, find_hits
from appearance.fields.kajiya_kay import KajiyaKay
from appearance.fields.neighbours import camera_weights, light_weights
from appearance.fields.reflectance import CapturedView, ReflectanceField
from appearance.render.coverage import sees
from reconstruction import Light, Strands
from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints

HITS = HitOptions(4, seed=91)
FLOOR = 0.3
"""Added to both sides of the guide's ratio, relative to its mean."""
_AT_ONCE = 1 << 14
"""Pixels in memory at a time."""


@dataclass(frozen=True, eq=False)
class Source:
    """A captured view and the `hits` of its pixels, in the pose of the capture; a pixel without
    strands has those of the nearest pixel with some."""

    view: CapturedView
    hits: Hits

    @classmethod
    def of(cls, view: CapturedView, mapped: MappedStrands) -> Source:
        """Raises `ValueError` if no pixel shows a strand."""
        hits = find_hits(mapped, view.camera, view.pixels, HITS)
        bare = hits.column("strand").max(axis=1) < 0
        if bare.all():
            raise ValueError(f"{view.camera.name}: no strand is in front of its hair pixels")
        place = np.stack(np.divmod(view.pixels, view.camera.width), -1)
        _, nearest = cKDTree(place[~bare]).query(place[bare])
        hits.table[bare] = hits.table[np.flatnonzero(~bare)[nearest]]
        return cls(view, hits)

    def guided(
        self, model: KajiyaKay | None, lights: Sequence[Light], pixels: Ints, epsilon: float = 0.0
    ) -> Floats:
        """Mean over a pixel's hits of irradiance times B + `epsilon`, or 1 without a `model`.

        `(L, Q, 3)` for the pixels of numbers `pixels (Q,)` under each light.
        """
        point, weight = self.hits.table["point"][pixels], self.hits.table["weight"][pixels]
        tangent = self.hits.table["tangent"][pixels]
        away = _unit(self.view.camera.center - point)
        share = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
        out = np.empty((len(lights), len(pixels), 3), np.float32)
        for i, light in enumerate(lights):
            found = share
            if model is not None:
                towards = _unit(light.position - point)
                found = share * (model(tangent, away, towards) + np.float32(epsilon))
            out[i] = np.einsum("qk,qkc->qc", found, irradiance(light, point))
        return out


@dataclass(frozen=True, eq=False)
class Interpolation:
    """Radiance of points on strands for any light and camera, interpolated from captured frames.

    Without a `model` the weighted mean of samples over their irradiance, times that of the new
    light. With a model B each sample is first scaled by (B + ε)/(B_ij + ε) (Photobooth, Eq. 5), ε
    being `floor` times the mean of B. Lights have radial weights (`light_weights`), visible cameras
    barycentric ones (`camera_weights`). `sources` and `mapped` are in the pose of `strands`.
    """

    field: ReflectanceField
    sources: tuple[Source, ...]
    mapped: MappedStrands
    strands: Strands
    model: KajiyaKay | None = None
    floor: float = FLOOR

    @classmethod
    def of(cls, field: ReflectanceField, mapped: MappedStrands, strands: Strands) -> Interpolation:
        """Standard interpolation of `field` on `strands`, which `mapped` holds."""
        sources = tuple(Source.of(view, mapped) for view in field.views)
        return cls(field, sources, mapped, strands)

    @property
    def middle(self) -> Array:
        """The hair's centre `(3,)`, from which directions to cameras and lights are compared."""
        return np.asarray(self.strands.points.mean(axis=0), float)

    @property
    def epsilon(self) -> float:
        """ε."""
        return 0.0 if self.model is None else self.floor * self.model.mean

    def neighbours(self, lights: Sequence[Light]) -> tuple[Ints, Floats]:
        """Numbers and weights `(L, k)` of the captured lights near each of `lights`."""
        captured, new = (
            _unit(np.array([x.position for x in many]) - self.middle).astype(float)
            for many in (self.field.lights, lights)
        )
        return light_weights(captured, new)

    def without(self, cameras: Sequence[str] = (), lights: Sequence[str] = ()) -> Interpolation:
        """The same without some cameras and lights."""
        kept = [i for i, light in enumerate(self.field.lights) if light.name not in lights]
        sources = tuple(
            replace(s, view=replace(s.view, table=s.view.table[kept] if lights else s.view.table))
            for s in self.sources
            if s.view.camera.name not in cameras
        )
        field = ReflectanceField(
            tuple(self.field.lights[i] for i in kept),
            tuple(s.view for s in sources),
            self.field.scale,
        )
        return replace(self, field=field, sources=sources)

    def at_hits(self, hits: Hits) -> Relit:
        """The field at the pixels of `hits`, of any camera and any pose of the same strands; a
        captured camera, by its source's `hits`, uses its own samples only."""
        for c, source in enumerate(self.sources):
            if hits is source.hits:
                return self._own(c)
        weights = camera_weights(
            _unit(np.array([s.view.camera.center for s in self.sources]) - self.middle),
            _unit(hits.camera.center - self.middle),
        )
        rest = self._at_rest(hits)
        hair = hits.column("weight") > 0
        index = np.full((len(self.sources), *hair.shape), -1)
        share = np.zeros(index.shape, np.float32)
        for c in np.flatnonzero(weights).tolist():
            self._look(c, rest, hair, index)
            share[c] = weights[c] * (index[c] >= 0)
        lost = hair & (share.sum(axis=0) == 0)
        if lost.any():
            away = np.array([s.view.camera.center for s in self.sources]) - self.middle
            cosine = _unit(away) @ _unit(hits.camera.center - self.middle)
            for c in np.flatnonzero(weights == 0).tolist():
                self._look(c, rest, lost, index)
                share[c] = np.exp(cosine[c] / 0.1) * (index[c] >= 0)
        total = share.sum(axis=0)
        share = np.divide(share, total, out=np.zeros_like(share), where=total > 0)
        return Relit(self, hits, index, share)

    def _own(self, c: int) -> Relit:
        """The field at the pixels of a captured camera: each its own."""
        hits = self.sources[c].hits
        index = np.full((len(self.sources), *hits.table.shape), -1)
        index[c] = np.arange(len(hits.pixels))[:, None]
        share = np.zeros(index.shape, np.float32)
        share[c] = 1
        return Relit(self, hits, index, share)

    def _look(self, c: int, rest: Floats, wanted: Bools, index: Ints) -> None:
        """Put into `index (C, P, K)` the pixels of source `c` that show the wanted points."""
        view = self.sources[c].view
        number = np.full(wanted.shape, -1)
        number[wanted] = view.index(rest[wanted])
        found = number >= 0
        visible = sees(self.mapped.scene, view.camera, rest[found].astype(float))
        number[found] = np.where(visible, number[found], -1)
        index[c] = number

    def _at_rest(self, hits: Hits) -> Floats:
        """The points of `hits` in the pose of the capture `(P, K, 3)`."""
        values = self.strands.points
        strand = np.maximum(hits.column("strand"), 0)
        offsets = self.strands.offsets
        last = offsets[strand + 1] - offsets[strand] - 1
        at = hits.column("along") * last
        low = np.minimum(at.astype(np.int64), last - 1)
        share = (at - low)[..., None].astype(np.float32)
        low += offsets[strand]
        return np.asarray(values[low] * (1 - share) + values[low + 1] * share)


@dataclass(frozen=True, eq=False)
class Relit:
    """An interpolation at the pixels of a camera, ready to be lit.

    `index (C, P, K)` are the sources' pixels of each hit, -1 where it is not visible; `share
    (C, P, K)` their weights, which sum to 1 over the cameras, or are 0 if none sees the hit.
    """

    of: Interpolation
    hits: Hits
    index: Ints
    share: Floats

    @property
    def known(self) -> Floats:
        """Share `(P,)` of each pixel's hits that are visible in some source."""
        return np.asarray((self.hits.column("weight") * (self.share.sum(axis=0) > 0)).sum(axis=1))

    def under(self, lights: Sequence[Light]) -> tuple[Floats, Floats]:
        """Mean radiance `(L, P, 3)` over each pixel's hits that have samples, 0 without, and their
        share `(L, P)`, less than `known` where samples are missing or saturated."""
        parts = [part._lit(lights) for part in self._parts()]
        if not parts:
            none = np.zeros((len(lights), 0, 3), np.float32)
            return none, none[..., 0]
        lit, known = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        return lit, known

    def under_all(self, lights: Sequence[Light]) -> tuple[Floats, Floats]:
        """`under` all lights together: `(P, 3)`, and the least share under any `(P,)`."""
        radiance = np.zeros((len(self.hits.pixels), 3), np.float32)
        known, start = np.zeros(len(radiance), np.float32), 0
        for part in self._parts():
            end = start + len(part.hits.pixels)
            lit, share = part._lit(lights)
            radiance[start:end] = lit.sum(axis=0)
            known[start:end] = share.min(axis=0) if len(lights) else 0
            start = end
        return radiance, known

    def _parts(self) -> Iterator[Relit]:
        """The same in blocks of pixels."""
        for start in range(0, len(self.hits.pixels), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            hits = replace(self.hits, pixels=self.hits.pixels[part], table=self.hits.table[part])
            yield Relit(self.of, hits, self.index[:, part], self.share[:, part])

    def _lit(self, lights: Sequence[Light]) -> tuple[Floats, Floats]:
        total = np.zeros((len(lights), len(self.hits.pixels), 3), np.float32)
        known = np.zeros(total.shape[:2], np.float32)
        for c in range(len(self.index)):
            self._add(c, lights, total, known)
        scale = np.float32(self.of.field.scale)
        lit = np.divide(total, known[..., None] * scale, out=total, where=known[..., None] > 0)
        return np.maximum(lit, 0), known

    def _add(self, c: int, lights: Sequence[Light], total: Floats, known: Floats) -> None:
        """Add source `c` to `total (L, P, 3)`, and its weight to `known (L, P)`."""
        share = self.share[c] * self.hits.column("weight")
        pixel, k = np.nonzero(share)
        if not len(pixel) or not len(lights):
            return
        used, number = np.unique(self.index[c][pixel, k], return_inverse=True)
        point, weight = self.hits.table["point"][pixel, k], share[pixel, k]
        tangent = self.hits.table["tangent"][pixel, k]
        away = _unit(self.hits.camera.center - point)
        order, weights = self.of.neighbours(lights)
        near, place = np.unique(order, return_inverse=True)
        incoming, place = self._incoming(c, near, used), place.reshape(order.shape)
        for i, light in enumerate(lights):
            value = weighted(incoming[place[i]], weights[i])[number] * irradiance(light, point)
            if self.of.model is not None:
                guide = self.of.model(tangent, away, _unit(light.position - point))
                value = value * (guide + np.float32(self.of.epsilon))[:, None]
            good = np.isfinite(value).all(axis=1)
            value = np.where(good[:, None], value, 0) * weight[:, None]
            for channel in range(3):
                total[i, :, channel] += np.bincount(pixel, value[:, channel], total.shape[1])
            known[i] += np.bincount(pixel, weight * good, known.shape[1])

    def _incoming(self, c: int, lights: Ints, pixels: Ints) -> Floats:
        """I_ij / E_ij / (B_ij + ε) of source `c` at its pixels `(Q,)`: `(k, Q, 3)`.

        For the captured lights of numbers `lights (k,)`; NaN for unknown samples.
        """
        source, near = self.of.sources[c], [self.of.field.lights[j] for j in lights]
        samples = source.view.table[lights][:, pixels].astype(np.float32)
        divisor = source.guided(self.of.model, near, pixels, self.of.epsilon)
        unknown = np.full_like(samples, np.nan)
        return np.asarray(np.divide(samples, divisor, out=unknown, where=divisor > 0))


def weighted(samples: AnyFloats, weights: AnyFloats) -> Floats:
    """The mean `(Q, 3)` of finite `samples (k, Q, 3)` by `weights (k,)`; NaN without any."""
    good: Any = np.isfinite(samples).all(axis=-1)
    each: Any = weights[:, None] * good
    known: Any = np.where(good[..., None], samples, 0)
    summed = np.einsum("kq,kqc->qc", each, known)
    total, unknown = each.sum(axis=0)[:, None], np.full_like(summed, np.nan)
    return np.asarray(np.divide(summed, total, out=unknown, where=total > 0), np.float32)


def irradiance(light: Light, points: Floats) -> Floats:
    """Irradiance `(P, 3)`, W/m², across the ray from a light at `points (P, 3)`."""
    return np.asarray(light.irradiance(points), np.float32)


def _unit(vectors: Array | Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12), np.float32)
