"""What every test may ask for."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import certifi
import pytest

# Before NumPy is loaded: on shared cores OpenBLAS's threads spin as they wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import settings
from simulating import simulating, small_rig_text
from waiting import machine_slack

from appearance.scene.backend import ensure_backend
from simulators.world import World
from stage_service.config import RigFile
from stage_service.devices.permission import Permission

CHECKOUT = Path(__file__).resolve().parents[1]

# The same order of sums every time, and a core for the other worker.
ensure_backend(threads=1)

# What runs in the background starts with Ctrl-C ignored, and so would the processes of the tests.
signal.signal(signal.SIGINT, signal.default_int_handler)

# An example takes as long as the machine is busy.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

FIRST = (
    "system",
    "faults",
    "stage_service/captures",
    "stage_service/web",
    "test_examples.py",
    "contracts",
    "appearance",
    "benchmarks",
)
"""What begins first: the longest files, what mostly waits, beside it what mostly computes."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`FIRST` in front; with `--no-loadscope-reorder` xdist keeps that order."""

    def place(item: pytest.Item) -> int:
        path = item.nodeid.removeprefix("tests/")
        return next((i for i, name in enumerate(FIRST) if path.startswith(name)), len(FIRST))

    items.sort(key=place)


@pytest.fixture(scope="session", autouse=True)
def own_token(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Whoever runs the tests keeps the token that they have."""
    file = tmp_path_factory.mktemp("user") / "token"
    file.write_text("a token of the tests\n")
    os.environ["HAIRSTAGE_TOKEN_FILE"] = str(file)


@pytest.fixture(scope="session", autouse=True)
def one_authority(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Tests connect to this machine alone: a client loads one certificate, not all there are."""
    end = "-----END CERTIFICATE-----"
    file = tmp_path_factory.mktemp("certificates") / "one.pem"
    file.write_text(certifi.contents().partition(end)[0] + end + "\n")
    certifi.where = lambda: str(file)


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


@pytest.fixture
def small_rig(slack: int) -> str:
    """The rig file's text that `simulated` uses: deadlines of 0.3 s, a watchdog of 0.5 s."""
    return small_rig_text(slack)


@pytest.fixture
def simulated(
    tmp_path: Path, small_rig: str, slack: int
) -> Iterator[Callable[..., tuple[RigFile, World]]]:
    """`simulated(*faults, rig=text)`: the simulators' devices, without a renderer, in this process.

    Returns the rig file, which leads to them, and the world behind them. The faults' `seconds` are
    those of an idle machine.
    """
    with simulating(tmp_path, small_rig, slack) as start:
        yield start
