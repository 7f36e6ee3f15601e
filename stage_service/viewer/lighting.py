"""Relighting of a viewed model: sums of OLAT frames, and data for the shader."""

from __future__ import annotations

import threading
from collections import OrderedDict
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from appearance import Exposure, FittedModel
from appearance.bsdf.far_field import azimuthal_table
from appearance.bsdf.lobes import logistic_scale, variances
from appearance.inverse_rendering.fitted_lights import fitted_lights
from appearance.model.light_sums import (
    LightSums,
    few_lights,
    lights_in_turn,
    reassigned,
    weights_of_environment,
)
from appearance.render.environment_maps import PROCEDURAL
from appearance.render.visibility import above_faces, reached, within_fibres
from reconstruction import Camera, Capture, Light, Model
from reconstruction.arrays import Array
from reconstruction.geometry.lights import dome_positions
from stage_service.viewer.errors import BadLight
from stage_service.viewer.packing import PackedStrands
from stage_service.viewer.resting import RestOptions, indirect_in_view

MOST_LIGHTS = 8
"""Lights in the shader."""
LIGHTS_AT_REST = 32
"""Lights for which indirect light is traced in one view."""
TURNS_OF_A_LIGHT = 8
"""Lights of the rig that each of these represents in turn, at rest."""
COSINES, TURNS = 24, 96
EXPOSURE_CAMERAS, EXPOSURE_LIGHTS, EXPOSURE_PIXELS = 2, 8, 512
"""Cameras, frames of each, and pixels per side from which an exposure is made without a fit."""
CACHED_LIGHTS = 48
"""Lights whose visibility is cached: a byte per point of the strands and of the head."""
DOME_LIGHTS, DOME_RADIUS = 331, 1.5
"""The dome of a model without its capture."""


class Lighting:
    """Light on one model, drawn as `packed`. Safe to use from several threads."""

    def __init__(self, model: Model, capture: Capture | None, packed: PackedStrands) -> None:
        self._model, self._capture, self._packed = model, capture, packed
        self._lock = threading.RLock()
        self._resting = threading.Lock()
        self._visibility: OrderedDict[int, bytes] = OrderedDict()
        self._sums: tuple[str, LightSums] | None = None

    @cached_property
    def lights(self) -> list[Light]:
        """The captured lights, as estimated by a fit if there is one, or a dome without a
        capture."""
        if self._capture is not None and (names := self._capture.olat_lights()):
            return fitted_lights(self._model, [self._capture.rig.light(n) for n in names])
        bright = np.full(3, 10.0)
        places = dome_positions(DOME_LIGHTS, DOME_RADIUS, -60)
        return [Light(f"light_{i:03d}", p, bright) for i, p in enumerate(places)]

    @cached_property
    def fitted(self) -> FittedModel:
        """The model with its material. Raises `ModelError` without a fit."""
        return FittedModel.load(self._model, self._capture)

    @cached_property
    def exposure(self) -> Exposure:
        """The fit's exposure, else that of some OLAT frames."""
        if self._model.has("appearance.json"):
            return self.fitted.appearance.exposure
        with self._lock:
            return Exposure(1.0) if self._capture is None else _exposure(self._capture)

    def about(self) -> dict[str, Any]:
        """Lights, and the fitted material if there is one; JSON-ready."""
        out: dict[str, Any] = {
            "lights": [{"name": x.name, "position": x.position.tolist()} for x in self.lights],
            "exposure": self.exposure.scale,
            "captured": self._capture is not None and bool(self._capture.olat_lights()),
            "missing": self._missing(),
            "material": None,
        }
        if self._model.has("appearance.json"):
            hair, fitted = self.fitted.maps.mean(), self.fitted
            out["material"] = {
                "cosines": COSINES,
                "turns": TURNS,
                "variances": [float(v) for v in variances(hair.beta_m)],
                "tilt": float(np.radians(hair.tilt_deg)),
                "eta": float(hair.eta),
                "logistic_scale": float(logistic_scale(hair.beta_n)),
                "absorption": [float(x) for x in hair.sigma_a],
                "skin": list(fitted.appearance.skin),
                "one_material": fitted.maps.uniform,
                "field": fitted.field is not None,
            }
        return out

    def _missing(self) -> dict[str, int]:
        """Number of missing OLAT frames by camera, for cameras that have some."""
        if self._capture is None:
            return {}
        has, names = self._capture.has_light, self._capture.olat_lights()
        found = {c.name: sum(not has(n, c.name) for n in names) for c in self._capture.rig.cameras}
        return {c: n for c, n in found.items() if 0 < n < len(names)}

    def table(self) -> bytes:
        """`azimuthal_table` of the hair `(4, COSINES, TURNS, 4)`, float32; the last channel is
        0."""
        cosines = (np.arange(COSINES) + 0.5) / COSINES
        turns = np.pi * (np.arange(TURNS) + 0.5) / TURNS
        values = azimuthal_table(self.fitted.maps.mean(), cosines, turns)
        return np.pad(values, ((0, 0),) * 3 + ((0, 1),)).astype("<f4").tobytes()

    def few(self, weights: dict[int, list[float]]) -> list[dict[str, Any]]:
        """The few lights that represent `weights` (number: RGB) in the shader, and in `turns` those
        that each of them represents at rest."""
        full = self._full(weights)
        chosen = few_lights(self.lights, full, MOST_LIGHTS)
        turns = lights_in_turn(self.lights, full, MOST_LIGHTS, TURNS_OF_A_LIGHT)
        return [
            {**self._placed(i, w), "turns": [self._placed(*x) for x in some]}
            for (i, w), some in zip(chosen, turns, strict=True)
        ]

    def _placed(self, number: int, weight: Array) -> dict[str, Any]:
        light = self.lights[number]
        return {
            "number": number,
            "position": light.position.tolist(),
            "intensity": (weight * light.intensity_towards(np.zeros(3))).tolist(),
        }

    def _full(self, weights: dict[int, list[float]]) -> Array:
        full = np.zeros((len(self.lights), 3))
        for number, value in weights.items():
            if not 0 <= number < len(self.lights):
                raise BadLight(f"light number {number}: expected 0 to {len(self.lights) - 1}")
            full[number] = value
        return full

    def indirect_in_view(self, camera: Camera, weights: dict[int, list[float]]) -> bytes:
        """Indirect light in one view under lights (number: RGB); see `indirect_in_view`; float32.

        Traces paths for seconds.
        """
        chosen = few_lights(self.lights, self._full(weights), LIGHTS_AT_REST)
        with self._resting:
            found = indirect_in_view(
                self._scene, camera, [(self.lights[i], w) for i, w in chosen], RestOptions()
            )
        return found.astype("<f4").tobytes()

    def visibility(self, number: int) -> bytes:
        """Visibility of light `number` from each point `(S, n)`, then each vertex of the head:
        uint8, 255 where a shadow ray reaches it."""
        with self._lock:
            found = self._visibility.get(number)
            if found is None:
                found = self._visibility[number] = self._traced(self.lights[number].position)
                if len(self._visibility) > CACHED_LIGHTS:
                    self._visibility.popitem(last=False)
            return found

    def _traced(self, towards: Array) -> bytes:
        points = self._packed.positions().reshape(-1, 3).astype(float)
        radii = np.repeat(self._packed.radii.astype(float), self._packed.points.shape[1])
        offset = within_fibres(points, towards, radii, seed=0)
        lit = reached(self._scene, points, towards, offset)
        head = self.fitted.head
        if head is not None:
            vertices = np.asarray(head.vertices, float)
            lifted = above_faces(vertices, head.faces)
            lit = np.append(lit, reached(self._scene, vertices, towards, lifted))
        return np.where(lit, 255, 0).astype(np.uint8).tobytes()

    @cached_property
    def _scene(self) -> Any:
        return self.fitted.without_field().scene()

    def environment(self, which: str, rotation_deg: float) -> Array:
        """Weights `(L, 3)` of the lights that represent the map "studio" or "sky". Raises
        `BadLight`."""
        if which not in PROCEDURAL:
            raise BadLight(f"unknown environment {which!r}: expected {' or '.join(PROCEDURAL)}")
        return weights_of_environment(self.lights, PROCEDURAL[which](), rotation_deg)

    def sum(self, camera: str, weights: dict[int, list[float]], exposure: float) -> bytes:
        """A PNG of the sum of `camera`'s frames weighted by lights (number: RGB), times `exposure`,
        sRGB. The nearest light replaces one whose frame is missing."""
        if self._capture is None:
            raise BadLight("the model has no captured frames: give --capture")
        with self._lock:
            if self._sums is None or self._sums[0] != camera:
                self._sums = None  # free its memory first
                self._sums = camera, LightSums(self._capture, camera)
            sums = self._sums[1]
        if not sums.names:
            raise BadLight(f"{camera}: the capture has no OLAT frame of this camera")
        there = np.isin([x.name for x in self.lights], sums.names)
        full = reassigned(self.lights, self._full(weights), there)
        radiance = sums({self.lights[i].name: full[i] for i in np.flatnonzero(full.any(axis=1))})
        values = np.rint(255 * Exposure(exposure)(radiance)).astype(np.uint8)
        return cv2.imencode(".png", values[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[
            1
        ].tobytes()


def _exposure(capture: Capture) -> Exposure:
    """The exposure of some OLAT frames; 1 if they are black."""
    lights, has, pixels = capture.olat_lights(), capture.has_light, [np.zeros((0, 3), np.float32)]
    shot = {c.name: [n for n in lights if has(n, c.name)] for c in capture.rig.cameras}
    for camera in [c for c, names in shot.items() if names][:EXPOSURE_CAMERAS]:
        for name in shot[camera][:: -(-len(shot[camera]) // EXPOSURE_LIGHTS)]:
            frame = capture.light(name, camera)[0]
            some = -(-max(frame.shape) // EXPOSURE_PIXELS)
            pixels.append(frame[::some, ::some].reshape(-1, 3))
    return Exposure.of_picture(np.concatenate(pixels))
