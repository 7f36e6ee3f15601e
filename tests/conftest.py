"""What every test may ask for."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray
from waiting import machine_slack, slowed

from appearance.scene.backend import ensure_backend
from reconstruction import Rig
from simulators.frames.frames import FrameMaker, Sensor
from simulators.frames.responses import Response
from simulators.peers.devices import DEVICES_FILE, SimulatedStage
from simulators.peers.faults import Fault
from simulators.peers.lamps import Lamps
from simulators.world import World
from stage_service.config import RigFile, load_rig_file
from stage_service.devices.permission import Permission

CHECKOUT = Path(__file__).resolve().parents[1]

# The same order of sums every time, and a core for the other worker.
ensure_backend(threads=1)

# What runs in the background starts with Ctrl-C ignored, and so would the processes of the tests.
signal.signal(signal.SIGINT, signal.default_int_handler)

# An example takes as long as the machine is busy.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

FIRST = ("system", "faults", "contracts", "appearance", "benchmarks")
"""Folders that begin first: what mostly waits, beside it what mostly computes and takes longest."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`FIRST` in front; with `--no-loadscope-reorder` xdist keeps that order."""
    place = {name: i for i, name in enumerate(FIRST)}
    tests = CHECKOUT / "tests"
    items.sort(key=lambda item: place.get(item.path.relative_to(tests).parts[0], len(FIRST)))


@pytest.fixture(scope="session", autouse=True)
def own_token(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Whoever runs the tests keeps the token that they have."""
    file = tmp_path_factory.mktemp("user") / "token"
    file.write_text("a token of the tests\n")
    os.environ["HAIRSTAGE_TOKEN_FILE"] = str(file)


@pytest.fixture
def slack() -> int:
    """How many times longer devices may take than on an idle machine; of one test, one number.

    The deadlines of the rig files, of the drivers and of the faults here are all this times longer:
    a test says what happens within a device's deadline, not how fast the machine is.
    """
    return machine_slack()


@pytest.fixture
def permitted() -> Iterator[None]:
    """The test lights the devices itself, as a run does that was granted permission."""
    with Permission.granted("a test").used():
        yield


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data(name)`: a file or folder of the test data, or a skip that says what to set.

    The data is looked for in $HAIRSTAGE_DATA, then in ../shared/data beside the checkout.
    """

    def locate(name: str) -> Path:
        folder = Path(os.environ.get("HAIRSTAGE_DATA", CHECKOUT.parent / "shared" / "data"))
        path = folder / name
        if not path.exists():
            pytest.skip(f"no test data at {path}; point HAIRSTAGE_DATA at the folder that has it")
        return path

    return locate


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


@pytest.fixture
def small_rig(slack: int) -> str:
    """The rig file's text that `simulated` uses: deadlines of 0.3 s, a watchdog of 0.5 s."""
    times = {"WATCHDOG_S": 0.5, "TIMEOUT_S": 0.3}
    text = SMALL_RIG
    for name, seconds in times.items():
        text = text.replace(name, f"{seconds * slack:g}")
    return text


@pytest.fixture
def simulated(
    tmp_path: Path, small_rig: str, slack: int
) -> Iterator[Callable[..., tuple[RigFile, World]]]:
    """`simulated(*faults, rig=text)`: the simulators' devices, without a renderer, in this process.

    Returns the rig file, which leads to them, and the world behind them. The faults' `seconds` are
    those of an idle machine.
    """
    with ExitStack() as stack:

        def start(*faults: Fault, rig: str = small_rig) -> tuple[RigFile, World]:
            path = tmp_path / f"small{len(list(tmp_path.glob('small*.toml')))}.toml"
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
