"""Frames from commanded states: weighted sums of the responses of a camera and pose, as sensor
counts."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction import Rig
from reconstruction.arrays import AnyFloats, Array, Floats
from simulators.frames.responses import Responder, Response
from simulators.peers.projector_controller import Show


@dataclass(frozen=True)
class Sensor:
    """A 12-bit sensor: counts = black + gain · exposure · radiance.

    At the default gain a 20 ms exposure saturates at 4.0 W/(sr m²); hair under one 8 W/sr lamp at
    1.2 m has 0.1 to 1, glints more. `electrons_per_count` gives a full well of 10,000 electrons;
    `read_noise` is in electrons.
    """

    full_scale: int = 4095
    black: int = 64
    gain: float = 50_000.0
    electrons_per_count: float = 2.48
    read_noise: float = 4.0

    def expose(
        self, radiance: AnyFloats, exposure: float, seed: tuple[int, ...]
    ) -> NDArray[np.uint16]:
        """Counts of `radiance (H, W, 3)`, W/(sr m²), after `exposure` seconds.

        Poisson shot noise and Gaussian read noise in electrons, then rounding and clipping. The
        same `seed` gives the same counts. Raises `ValueError` for NaN.
        """
        if np.isnan(radiance).any():
            where = np.argwhere(np.isnan(radiance))[0].tolist()
            raise ValueError(f"radiance is not a number at (row, column, channel) {where}")
        rng = np.random.default_rng(seed)
        mean = np.asarray(radiance, np.float64) * (exposure * self.gain * self.electrons_per_count)
        # clipped far beyond saturation: Poisson draws have a limit
        electrons = rng.poisson(np.clip(mean, 0, 1e9)).astype(np.float64)
        electrons += self.read_noise * rng.standard_normal(mean.shape)
        counts = np.rint(electrons / self.electrons_per_count + self.black)
        return np.clip(counts, 0, self.full_scale).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The commanded state at a trigger pulse, which determines a frame.

    `power (L,)` is the lamps' share of full intensity, `pose` the subject's.
    """

    pulse: int
    power: Array
    show: Show
    pose: int


class FrameMaker:
    """Makes counts of snapshots, with a cache of responses.

    At pose 0 the response of each light is cached, beyond `in_memory` bytes in temporary files, and
    frames are weighted sums; at other poses, where only closing frames have lights, one image per
    light vector is rendered. Sweeps are cached for the last two poses of each camera. Threads may
    request frames of different cameras at the same time.
    """

    def __init__(
        self,
        rig: Rig,
        responder: Responder,
        sensor: Sensor,
        seed: int,
        in_memory: int = 1 << 30,
    ) -> None:
        self._in_memory = in_memory
        self._rig, self._responder, self._sensor = rig, responder, sensor
        self._seed = seed
        self._lights: dict[str, Response] = {}
        names = [c.name for c in rig.cameras]
        self._moved = {n: OrderedDict[Hashable, Response]() for n in names}
        self._sweeps = {n: OrderedDict[Hashable, Mapping[str, Response]]() for n in names}

    def counts(self, camera: str, shot: Snapshot, exposure: float) -> NDArray[np.uint16]:
        """The sensor's counts `(H, W, 3)`; the same seed, camera and pulse give the same bytes."""
        index = [c.name for c in self._rig.cameras].index(camera)
        radiance = self.radiance(camera, shot)
        return self._sensor.expose(radiance, exposure, (self._seed, index, shot.pulse))

    def counts_at_rest(self, camera: str, shot: Snapshot, exposure: float) -> NDArray[np.uint16]:
        """`counts (H, W, 3)` of a subject without drift: all poses are pose 0."""
        return self.counts(camera, replace(shot, pose=0), exposure)

    def radiance(self, camera: str, shot: Snapshot) -> Floats:
        """Radiance `(H, W, 3)`, W/(sr m²), without noise."""
        c = self._rig.camera(camera)
        flat = np.zeros((c.height * c.width, 3), np.float32)
        if shot.power.any():
            self._add_lights(flat, camera, shot)
        if shot.show.level > 0:
            self._add_projectors(flat, camera, shot)
        return flat.reshape(c.height, c.width, 3)

    def _add_lights(self, flat: Floats, camera: str, shot: Snapshot) -> None:
        if shot.pose == 0:
            response = self._all_lights(camera)
            lit = np.flatnonzero(shot.power)
            weights = shot.power[lit].astype(np.float32)
            flat[response.pixels] += np.tensordot(weights, response.images[lit], 1)
            return
        key = (shot.pose, shot.power.tobytes())
        render = partial(self._responder.lights_together, camera, shot.pose, shot.power)
        response = _cached(self._moved[camera], key, render, 4)
        flat[response.pixels] += response.images[0]

    def _add_projectors(self, flat: Floats, camera: str, shot: Snapshot) -> None:
        render = partial(self._responder.sweep, camera, shot.pose)
        sweep = _cached(self._sweeps[camera], shot.pose, render, 2)
        power = np.float32(shot.show.power)
        for name, response in sweep.items():
            if shot.show.projector is None:
                flat[response.pixels] += power * response.total()
            elif shot.show.projector == name:
                flat[response.pixels] += power * response.image(shot.show.row)

    def _all_lights(self, camera: str) -> Response:
        if camera not in self._lights:
            response = self._responder.lights(camera)
            held = sum(x.images.nbytes for x in list(self._lights.values()))
            if held + response.images.nbytes > self._in_memory:
                response = replace(response, images=_on_disk(response.images))
            self._lights[camera] = response
        return self._lights[camera]


def _on_disk(images: NDArray[Any]) -> NDArray[Any]:
    """A copy in a temporary file, mapped into memory."""
    with TemporaryFile() as file:
        images.tofile(file)
        return np.memmap(file, images.dtype, "r", shape=images.shape)


def _cached(store: OrderedDict[Any, Any], key: Hashable, make: Callable[[], Any], most: int) -> Any:
    """`store[key]`, made if absent; the least recently used beyond `most` is dropped."""
    if key not in store:
        store[key] = make()
    store.move_to_end(key)
    while len(store) > most:
        store.popitem(last=False)
    return store[key]
