"""A viewed model: strands, head, true strands, the capture's cameras and frames."""

from __future__ import annotations

import threading
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from reconstruction import Capture, Mesh, Model, Strands
from reconstruction.arrays import Floats
from stage_service.viewer.errors import BadLight as BadLight
from stage_service.viewer.errors import NothingToView as NothingToView
from stage_service.viewer.packing import PackedStrands

if TYPE_CHECKING:
    from stage_service.viewer.lighting import Lighting

FAR = 5e-3
"""Metres from the nearest measured point beyond which a point is not measured."""


MOST_PIXELS = 100_000
"""Pixels of a view for which light is traced."""


class Viewed:
    """A model for the viewer, with its `capture` and true strands if given.

    Data is computed on first use and cached. Safe to use from several threads.
    """

    def __init__(
        self, model: Model, capture: Capture | None = None, truth: Strands | None = None
    ) -> None:
        self.model, self.truth = model, truth
        self.capture = None if capture is None else capture.view(undistorted=True)
        self.lock = threading.RLock()

    @cached_property
    def strands(self) -> Strands:
        """The model's strands."""
        return self.model.strands()

    @cached_property
    def head(self) -> Mesh | None:
        """The head under them."""
        return self.model.head(self.capture)

    def packed(self, which: str) -> PackedStrands:
        """The strands of the "model" or of the "truth". Raises `NothingToView`."""
        with self.lock:
            if which == "model":
                return self._packed
            if which == "truth" and self.truth is not None:
                return self._packed_truth
        raise NothingToView(f"unknown strands {which!r}: expected 'model', or 'truth' if given")

    @cached_property
    def _packed(self) -> PackedStrands:
        return PackedStrands.of(self.strands)

    @cached_property
    def _packed_truth(self) -> PackedStrands:
        assert self.truth is not None
        return PackedStrands.of(self.truth)

    @property
    def lighting(self) -> Lighting:
        """Its relighting. Imports the renderer, which the service does not need otherwise."""
        with self.lock:
            return self._lighting

    @cached_property
    def _lighting(self) -> Lighting:
        from stage_service.viewer.lighting import Lighting

        return Lighting(self.model, self.capture, self._packed)

    def prepare(self) -> None:
        """Load and compile what the first light needs; nothing without a fit. Raises nothing."""
        with suppress(Exception):  # the first light's own request reports it
            if self.model.has("appearance.json"):
                self.lighting.visibility(0)

    def about(self) -> dict[str, Any]:
        """Contents, JSON-ready: sets of strands, head, confidence, cameras."""
        sets = ["model"] if self.truth is None else ["model", "truth"]
        rig = None if self.capture is None else self.capture.rig
        return {
            "name": self.model.path.resolve().name,
            "strands": {name: _described(self.packed(name)) for name in sets},
            "head": self.head is not None,
            "confidence": self.model.has("points.npz"),
            "confidence_mm": 1e3 * FAR,
            "cameras": []
            if rig is None
            else [
                {
                    "name": c.name,
                    "width": c.width,
                    "height": c.height,
                    "K": c.K.tolist(),
                    "R": c.R.tolist(),
                    "t": c.t.tolist(),
                }
                for c in rig.cameras
            ],
        }

    def head_bytes(self) -> bytes:
        """The head: numbers of vertices and faces (uint32), vertices (float32), faces (uint32)."""
        head = self.head
        if head is None:
            raise NothingToView("no head: neither the model nor its capture has one")
        sizes = np.array([len(head.vertices), len(head.faces)], "<u4")
        parts = (sizes, head.vertices.astype("<f4"), head.faces.astype("<u4"))
        return b"".join(np.ascontiguousarray(p).tobytes() for p in parts)

    def confidence(self) -> bytes:
        """Distance of each point `(S, n)` to a measured one, uint8: 255 at 0, 0 from `FAR` on."""
        with self.lock:
            return self._confidence

    @cached_property
    def _confidence(self) -> bytes:
        from scipy.spatial import cKDTree  # slow to load, and not needed to start a service

        if not self.model.has("points.npz"):
            raise NothingToView("the model has no measured points: it was not made from a sweep")
        measured: Floats = self.model.points().points.astype(np.float32)
        places = self._packed.positions()
        every = max(1, places.shape[1] // 16)  # points between are interpolated
        at = np.unique(np.append(np.arange(0, places.shape[1], every), places.shape[1] - 1))
        tree = cKDTree(measured)
        distance, _ = tree.query(places[:, at], distance_upper_bound=FAR)
        near = 1 - np.minimum(distance, FAR) / FAR
        right = np.clip(np.searchsorted(at, np.arange(places.shape[1])), 1, len(at) - 1)
        share = (np.arange(places.shape[1]) - at[right - 1]) / (at[right] - at[right - 1])
        full = near[:, right - 1] * (1 - share) + near[:, right] * share
        return np.rint(255 * full).astype(np.uint8).tobytes()


def _described(packed: PackedStrands) -> dict[str, Any]:
    span = packed.points.reshape(-1, 3)
    high = span.max(axis=0) if len(span) else np.zeros(3)
    return {
        "count": len(packed.points),
        "points": packed.points.shape[1],
        "low": packed.low.tolist(),
        "high": (packed.low + packed.step * high).tolist(),
        "step": packed.step,
        "longest": float(packed.lengths.max()) if len(packed.lengths) else 0.0,
        "deviation_mm": [1e3 * d for d in packed.deviation],
    }
