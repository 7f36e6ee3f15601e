"""`python -m benchmarks.service.flat_stage RIG STATE`: a simulated stage without a renderer.

Every frame is one grey, made at once, so that seconds are those of the service and the wires.
"""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import numpy as np

from reconstruction import Rig
from reconstruction.arrays import Array
from simulators.frames.frames import FrameMaker, Sensor
from simulators.frames.responses import Response
from simulators.peers.devices import SimulatedStage
from simulators.peers.faults import Faults
from simulators.peers.lamps import Lamps
from simulators.world import World
from stage_service.config import load_rig_file
from stage_service.signals import taken


class Flat:
    """What a camera sees: the more of a light's or a row's number, the brighter."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def lights(self, camera: str) -> Response:
        """Under each light."""
        return self._grey(camera, _levels(len(self.rig.lights)))

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """Under several lights at their `power`."""
        return self._grey(camera, np.array([_levels(len(power)) @ power]))

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        """Under each row of each projector."""
        return {
            p.name: self._grey(camera, 2 * _levels(p.height) + pose) for p in self.rig.projectors
        }

    def _grey(self, name: str, levels: Array) -> Response:
        camera = self.rig.camera(name)
        pixels = np.arange(camera.width * camera.height)
        shape = (len(levels), len(pixels), 3)
        return Response(pixels, np.broadcast_to(levels[:, None, None], shape).astype(np.float32))


def _levels(count: int) -> Array:
    return np.linspace(0.1, 0.1 * count, count)


def main() -> None:
    """Run it until SIGTERM or SIGINT; says in one line of JSON that it is ready."""
    rig, state = load_rig_file(sys.argv[1]), Path(sys.argv[2])
    assert rig.devices is not None
    sensor, cameras = Sensor(), [c.name for c in rig.rig.cameras]
    frames = FrameMaker(rig.rig, Flat(rig.rig), sensor, 0)
    world = World(rig.rig, Lamps(len(rig.rig.lights)), Faults(), frames.counts)
    wait = taken(signal.SIGTERM, signal.SIGINT)
    with SimulatedStage(world, sensor, state, rig.devices, free_ports=True):
        print(json.dumps({"cameras": cameras}), flush=True)
        wait()


if __name__ == "__main__":
    main()
