"""The simulators' devices in the process of the tests; every picture is one grey."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from waiting import slowed

from reconstruction import Mesh, Rig, Strands, write_obj, write_strands
from simulators.frames.frames import FrameMaker, Sensor
from simulators.frames.responses import Response
from simulators.peers.devices import DEVICES_FILE, SimulatedStage
from simulators.peers.faults import Fault
from simulators.peers.lamps import Lamps
from simulators.world import World
from stage_service.config import RigFile, load_rig_file

SMALL_RIG = """
name = "small"
[dome]
lights = 24
radius = 1.2
intensity = [8.0, 8.0, 8.0]
[[cameras]]
name = "cam_a"
position = [0.0, -0.95, 0.12]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 16
height = 12
[[cameras]]
name = "cam_b"
position = [0.7, 0.6, 0.3]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 16
height = 12
[[projectors]]
name = "left"
position = [0.4, -0.9, 0.5]
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = 16
height = 16
[devices]
hardware_stepping = true
heartbeat_s = 0.05
watchdog_s = WATCHDOG_S
[devices.lights]
timeout_s = TIMEOUT_S
[devices.trigger]
port = "none"
timeout_s = TIMEOUT_S
[devices.projectors]
port = "none"
timeout_s = TIMEOUT_S
[devices.cameras]
port = 1
timeout_s = TIMEOUT_S
readout_s = 0.001
[safety]
living_subject = false
[capture]
tracking_every = 5
[capture.exposure]
dark = 0.002
all_on = 0.002
olat = 0.002
scanline = 0.002
tracking = 0.002
"""


class Flat:
    """What the simulated subject answers, known beforehand: every picture is one grey.

    Lamp i gives 0.1 (i + 1) at full level, row r 0.2 (r + 1) + pose, W/(sr m²).
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def lights(self, camera: str) -> Response:
        """Each lamp by itself."""
        return self._flat(camera, 0.1 * (1 + np.arange(len(self.rig.lights))))

    def lights_together(self, camera: str, pose: int, power: NDArray[np.float64]) -> Response:
        """All lamps at these powers."""
        return self._flat(camera, np.array([0.1 * (1 + np.arange(len(power))) @ power]))

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        """Each row by itself."""
        return {
            p.name: self._flat(camera, 0.2 * (1 + np.arange(p.height)) + pose)
            for p in self.rig.projectors
        }

    def _flat(self, camera: str, levels: NDArray[np.float64]) -> Response:
        c = self.rig.camera(camera)
        pixels = np.arange(c.width * c.height)
        images = np.broadcast_to(levels[:, None, None], (len(levels), len(pixels), 3))
        return Response(pixels, images.astype(np.float32))


def small_subject(folder: Path) -> list[str | Path]:
    """Arguments of `python -m simulators` for three strands on a tetrahedron, fast to render."""
    corners = 0.08 * np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    write_obj(folder / "head.obj", Mesh(corners, faces, np.ones(4, bool)))
    lines = [np.linspace(1.0, 1.5, 5)[:, None] * corner for corner in corners[:3]]
    write_strands(folder / "subject.npz", Strands.from_list(lines, radius=1e-3))
    return ["--subject", folder / "subject.npz", "--head", folder / "head.obj"]


def small_rig_text(slack: int, deadline_s: float = 0.3) -> str:
    """`SMALL_RIG` with these deadlines and a watchdog of 0.5 s, `slack` times as long."""
    times = {"WATCHDOG_S": 0.5, "TIMEOUT_S": deadline_s}
    text = SMALL_RIG
    for name, seconds in times.items():
        text = text.replace(name, f"{seconds * slack:g}")
    return text


@contextmanager
def simulating(
    folder: Path, small_rig: str, slack: int
) -> Iterator[Callable[..., tuple[RigFile, World]]]:
    """`start(*faults, rig=small_rig)`: devices that last as long as the context.

    Returns the rig file, in `folder`, and the world behind the devices. The faults' `seconds` are
    those of an idle machine; where there are none, no device is late and deadlines are 3 s.
    """
    with ExitStack() as stack:

        def start(*faults: Fault, rig: str = small_rig) -> tuple[RigFile, World]:
            if not faults and rig is small_rig:
                rig = small_rig_text(slack, 3.0)
            path = folder / f"small{len(list(folder.glob('small*.toml')))}.toml"
            path.write_text(rig)
            rig_file = load_rig_file(path)
            known, used, sensor = rig_file.rig, slowed(faults, slack), Sensor()
            frames = FrameMaker(known, Flat(known), sensor, 0)
            world = World(known, Lamps(len(known.lights)), used, frames.counts)
            state = path.with_suffix("")
            stage = SimulatedStage(world, sensor, state, rig_file.devices)
            stack.enter_context(stage)
            return load_rig_file(path, state / DEVICES_FILE), world

        yield start
