"""Simulated captures for benchmarks: made through the wires, once, and kept."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from reconstruction import Progress, silent
from reconstruction.capture.compression import compress
from stage_service.cli.support.children import Children, SimulatedRig, own_command
from stage_service.cli.support.client import ServiceClient
from stage_service.cli.support.commands import FAILED, CommandError

VERSION = 1
"""Of the frames: another number makes kept captures stale."""


@dataclass(frozen=True)
class SimulatedCapture:
    """What is shot: a subject (a procedural one's name, or a strand file with its head) in a rig.

    `rig` is a rig file's text. The subject drifts by up to `drift_mm`; `spp` paths a pixel.
    """

    name: str
    rig: str
    subject: str
    head: str | None = None
    drift_mm: float = 0.0
    spp: int = 16
    seed: int = 0

    def key(self) -> str:
        """A folder's name: the same for the same frames, wherever the files of the subject lie."""
        said = {**asdict(self), "subject": _content(self.subject), "head": _content(self.head)}
        total = hashlib.sha256(json.dumps([VERSION, said], sort_keys=True).encode())
        return f"{self.name}-{total.hexdigest()[:12]}"

    def make(self, cache: Path, progress: Progress = silent) -> tuple[Path, Path]:
        """The capture's folder and its truth's (strands.npz, head.obj, poses.json, ...).

        Kept under `cache`; a capture that was cut short is made again. Raises `CommandError`.
        """
        folder = cache.resolve() / self.key()
        done = folder / "done.json"
        if not done.is_file():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            path = self._shoot(folder, cache, progress)
            compress(path, progress)
            done.write_text(json.dumps({"capture": str(path.relative_to(folder))}) + "\n")
        return folder / json.loads(done.read_text())["capture"], folder / "truth"

    def _shoot(self, folder: Path, cache: Path, progress: Progress) -> Path:
        rig = folder / "rig.toml"
        rig.write_text(self.rig)
        truth = folder / "truth"
        command = SimulatedRig(rig, self.subject, self.head, self.seed).command(
            *("--state", folder / "simulated", "--truth", truth, "--ports", "auto"),
            *("--spp", str(self.spp), "--drift-mm", str(self.drift_mm)),
        )
        with Children(folder / "logs") as children:
            devices = children.ready("simulators", command, 300)["devices"]
            serve = own_command("serve", "--json", "--rig", rig, "--devices", devices)
            serve += ["--root", str(folder), "--port", "0"]
            service = children.start("service", serve, pipe=True)
            with ServiceClient(children.first_line("service", service, 60)["url"]) as client:
                body: dict[str, Any] = {"plan": {}}
                if (truth / "head.obj").is_file():
                    body["head"] = str(truth / "head.obj")
                capture = client.post("/captures", body)
                capture = client.follow_capture(capture["id"], progress, children.check)
        if capture["outcome"] != "completed":
            raise CommandError(f"{self.name}: {capture['outcome']}: {capture['error']}", FAILED)
        return Path(capture["path"]).resolve()


@dataclass(frozen=True)
class Optics:
    """Cameras or projectors that look at one point."""

    target: tuple[float, float, float]
    fov_deg: float

    def device(self, kind: str, number: int, position: Sequence[float]) -> str:
        """The start of a device's table in a rig file."""
        name = f"{'cam' if kind == 'cameras' else 'proj'}_{number:02d}"
        return (
            f'[[{kind}]]\nname = "{name}"\nposition = {[round(p, 5) for p in position]}\n'
            f"target = {list(self.target)}\nfov_deg = {self.fov_deg:.5f}\n"
        )


def levels(all_on: float) -> str:
    """Exposures and levels of a rig file."""
    exposure = ", ".join(f"{k} = 0.02" for k in ("dark", "all_on", "olat", "scanline", "tracking"))
    return (
        f"retries = 2\nexposure = {{{exposure}}}\n"
        f"level = {{all_on = {all_on}, olat = 1.0, scanline = 1.0, tracking = 0.4}}"
    )


def rig_file(name: str, dome: str, devices: Sequence[str], capture: str) -> str:
    """The text of a simulated rig's file: tables of `dome`, cameras and projectors, `capture`."""
    swept = any(text.startswith("[[projectors]]") for text in devices)
    tables = [
        f'name = "{name}"',
        f"[dome]\nintensity = [8.0, 8.0, 8.0]\n{dome}",
        *devices,
        "[devices]\nheartbeat_s = 1.0\nwatchdog_s = 10.0",
        '[devices.lights]\nkind = "modbus_tcp"\nhost = "127.0.0.1"\nport = 15020',
        '[devices.trigger]\nkind = "serial"\nport = "trigger"',
        *['[devices.projectors]\nkind = "serial"\nport = "projectors"'] * swept,
        '[devices.cameras]\nkind = "link"\nhost = "127.0.0.1"\nport = 15021\n'
        "timeout_s = 120.0\nbusy_s = 14400.0",
        "[safety]\nliving_subject = false",
        f"[capture]\n{capture}",
    ]
    return "\n\n".join(tables) + "\n"


def _content(subject: str | None) -> str | None:
    """The digest of a file, or what is no file as it is."""
    if subject is None or not Path(subject).is_file():
        return subject
    return hashlib.sha256(Path(subject).read_bytes()).hexdigest()
