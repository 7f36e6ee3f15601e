"""A whole stage in three processes, small enough to shoot and process in seconds.

These tests go only through HTTP, the command line and the wires.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import cv2
import httpx
import numpy as np
import pytest
from waiting import machine_slack, until

from reconstruction import Mesh, Rig, Strands, write_obj, write_strands

T = TypeVar("T")
LIGHTS, CAMERAS, ROWS = 24, 3, 16
FRAMES = CAMERAS * (LIGHTS + ROWS + 1 + 4)  # one tracking frame, dark and all-on at both ends

RIG = f"""
name = "tiny"
[dome]
lights = {LIGHTS}
radius = 1.2
intensity = [8.0, 8.0, 8.0]
beside_cameras_at = 0.05
[safety]
living_subject = false
[devices]
heartbeat_s = 0.2
watchdog_s = WATCHDOG_S
[devices.lights]
port = 15020
timeout_s = 20.0
[devices.trigger]
port = "trigger"
timeout_s = 20.0  # a lost reply leaves the lamp lit that long: time to kill the service
[devices.projectors]
port = "projectors"
timeout_s = 20.0
[devices.cameras]
port = 15021
timeout_s = 20.0
busy_s = 120.0
""" + "".join(
    f"""
[[{kind}]]
name = "{name}"
position = {position}
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = {size}
height = {size}
{more}
"""
    for kind, name, position, size, more in (
        ("cameras", "cam_0", [-0.5, -0.8, 0.2], 24, ""),
        ("cameras", "cam_1", [0.0, -0.95, 0.2], 24, ""),
        ("cameras", "cam_2", [0.5, -0.8, 0.2], 24, ""),
        ("projectors", "proj", [0.1, -0.9, 0.5], ROWS, "intensity = [20.0, 20.0, 20.0]"),
    )
)


class TinyStage:
    """Simulators, service and worker as a user starts them; everything ends with `close`."""

    LIGHTS, CAMERAS, FRAMES = LIGHTS, CAMERAS, FRAMES

    def __init__(self, folder: Path) -> None:
        self.folder, self.root = folder, folder / "root"
        self.rig = folder / "rig.toml"
        self.slack = machine_slack()
        self.watchdog_s = 1.0 * self.slack
        self.rig.write_text(RIG.replace("WATCHDOG_S", str(self.watchdog_s)))
        _write_subject(folder)
        self._running: list[subprocess.Popen[str]] = []
        self.waited_for: list[dict[str, Any]] = []  # by `capture`
        self.workers: list[subprocess.Popen[str]] = []
        self.http = httpx.Client(timeout=120, trust_env=False)

    def until(self, what: Callable[[], T], seconds: float = 60.0) -> T:
        """What `what` returns once that is true; fails after `seconds` of an idle machine."""
        return until(what, seconds * self.slack, pause=0.1)

    def start(self, *words: str | Path) -> tuple[subprocess.Popen[str], dict[str, Any]]:
        """Start `hairstage …` and read the object that it prints when it is ready."""
        command = [sys.executable, "-m", "stage_service.cli", *map(str, words), "--json"]
        log = (self.folder / f"{words[0]}.log").open("a")
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        log.close()
        self._running.append(child)
        assert child.stdout is not None
        line = child.stdout.readline()
        assert line, (self.folder / f"{words[0]}.log").read_text()
        return child, json.loads(line)

    def simulate(self, faults: list[dict[str, Any]] | None = None) -> subprocess.Popen[str]:
        """Start the simulated rig."""
        state = self.folder / "simulated"
        words: list[str | Path] = ["simulate", "--rig", self.rig, "--state", state]
        words += ["--spp", "512"]  # frames take long enough to be waited for
        words += ["--subject", self.folder / "subject.npz", "--head", self.folder / "head.obj"]
        words += ["--truth", self.folder / "truth"]
        if faults is not None:
            (self.folder / "faults.json").write_text(json.dumps(faults))
            words += ["--faults", self.folder / "faults.json"]
        child, ready = self.start(*words)
        self.devices = Path(ready["devices"])
        return child

    def serve(self) -> subprocess.Popen[str]:
        """Start the service."""
        words = ("serve", "--rig", self.rig, "--devices", self.devices, "--root", self.root)
        child, ready = self.start(*words, "--port", "0")
        self.http.base_url = ready["url"]
        token = Path(os.environ["HAIRSTAGE_TOKEN_FILE"]).read_text().strip()
        self.http.headers["Authorization"] = f"Bearer {token}"
        return child

    def work(self) -> subprocess.Popen[str]:
        """Start a worker."""
        self.workers.append(self.start("worker", "--root", self.root)[0])
        return self.workers[-1]

    def get(self, path: str) -> Any:
        """The JSON at `path`."""
        response = self.http.get(path)
        assert response.is_success, response.text
        return response.json()

    def post(self, path: str, body: Any = None) -> Any:
        """Post `body`; the answer's JSON."""
        response = self.http.post(path, json=body)
        assert response.is_success, response.text
        return response.json()

    def subject(self) -> dict[str, str]:
        """What a user knows of the subject: the digitised head, and masks of the hair."""
        return {"head": str(self.folder / "head.obj"), "masks": str(self.folder / "masks")}

    @staticmethod
    def pipeline(**options: Any) -> dict[str, Any]:
        """The whole pipeline at a quality for pictures of 24 pixels."""
        quality = {
            "reconstruct": {
                **{"roots": 1000, "grid": 6e-3, "within": 0.05},
                "measure": {"bank": {"wavelength": 6.0, "count": 24, "spread": 1.5}},
            },
            "fit": {"iterations": 2, "roughness_spp": 4, "error_paths": 10_000},
            "assess": {"spp": 4, "relit_size": 48, "relit_spp": 4},
        }
        return {"name": "light_planes", "options": {**quality, **options}}

    def capture(self, body: dict[str, Any]) -> dict[str, Any]:
        """Make a capture and wait until it is done."""
        path = f"/captures/{self.post('/captures', body)['id']}"
        self.until(lambda: self._look(path)["state"] == "done", 120)
        return self._look(path)

    def _look(self, path: str) -> dict[str, Any]:
        status: dict[str, Any] = self.get(path)
        if status["progress"] and status["progress"]["waiting"]:
            self.waited_for.append(status["progress"])
        return status

    def lamps_lit(self) -> int:
        """Lamps that are lit, asked over Modbus TCP by hand (read input register 1 of unit 1)."""
        lights = tomllib.loads(self.devices.read_text())["devices"]["lights"]
        with socket.create_connection(("127.0.0.1", lights["port"]), timeout=60) as bank:
            bank.sendall(struct.pack(">HHHBBHH", 7, 0, 6, 1, 4, 1, 1))
            reply = bank.recv(11, socket.MSG_WAITALL)
        lit: int = struct.unpack(">HHHBBBH", reply)[-1]
        return lit

    def verify(self, capture: Path) -> list[str]:
        """What `hairstage verify` has to say about a capture."""
        command = [sys.executable, "-m", "stage_service.cli", "verify", str(capture), "--json"]
        done = subprocess.run(command, capture_output=True, text=True)
        problems: list[str] = json.loads(done.stdout)["problems"]
        assert done.returncode == (1 if problems else 0)
        return problems

    def close(self) -> None:
        """End everything, the service before the rig."""
        self.http.close()
        for child in reversed(self._running):
            child.terminate()
            try:
                child.wait(60)
            finally:
                child.kill()
                child.wait()
                assert child.stdout is not None
                child.stdout.close()


def _write_subject(folder: Path) -> None:
    """200 strands that hang from the upper half of a ball, and the ball, its upper half scalp."""
    rng = np.random.default_rng(0)
    across, up = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(-np.pi / 2, np.pi / 2, 13))
    ball = np.stack([np.cos(across) * np.cos(up), np.sin(across) * np.cos(up), np.sin(up)], axis=-1)
    i = np.arange(12)[:, None] * 25 + np.arange(24)
    faces = np.concatenate([np.stack([i, i + 1, i + 26], -1), np.stack([i, i + 26, i + 25], -1)])
    vertices, faces = 0.08 * ball.reshape(-1, 3), faces.reshape(-1, 3)
    scalp = vertices[faces].mean(axis=1)[:, 2] > 0.01
    write_obj(folder / "head.obj", Mesh(vertices, faces, scalp))
    height, angle = rng.uniform(0.3, 1.0, 200), rng.uniform(0, 2 * np.pi, 200)
    radius = np.sqrt(1 - height**2)
    roots = 0.08 * np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    outwards = roots / np.linalg.norm(roots, axis=1, keepdims=True)
    s = np.linspace(0, 1, 12)[:, None]
    strands = [
        r + 0.03 * s * n + [0, 0, -0.05] * s**2 for r, n in zip(roots, outwards, strict=True)
    ]
    hair = Strands.from_list(strands, radius=1.5e-3)
    write_strands(folder / "subject.npz", hair)
    # At 14 mm a pixel only a person can tell hair from skin: the masks come from the user.
    (folder / "masks").mkdir()
    for camera in Rig.load(folder / "rig.toml").cameras:
        mask = np.zeros((camera.height, camera.width), np.uint8)
        front = hair.points[(hair.points - camera.center) @ camera.R[2] < np.linalg.norm(camera.t)]
        x, y = np.rint(camera.project(front)[0]).astype(int).T
        mask[y, x] = 255
        cv2.imwrite(str(folder / "masks" / f"{camera.name}.png"), mask)


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[TinyStage]:
    """A stage of one's own, nothing started yet."""
    stage = TinyStage(tmp_path)
    yield stage
    stage.close()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TinyStage]:
    """Simulated rig and service that all tests of a file share; no worker yet."""
    stage = TinyStage(tmp_path_factory.mktemp("stage"))
    try:
        stage.simulate()
        stage.serve()
        yield stage
    finally:
        stage.close()
