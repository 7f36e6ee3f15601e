"""Simulated captures for benchmarks: made through the wires, once, and kept."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from reconstruction.capture.compression import compress
from reconstruction.report.report import Progress, silent
from stage_service.cli.support import FAILED, CommandError
from stage_service.cli.support.children import Children, SimulatedRig, own_command
from stage_service.cli.support.client import ServiceClient

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
            *("--cache", cache.resolve() / "lamps"),
        )
        with Children(folder / "logs") as children:
            devices = children.ready("simulators", command, 300)["devices"]
            serve = own_command("serve", "--json", "--rig", rig, "--devices", devices)
            serve += ["--root", str(folder), "--port", "0"]
            service = children.start("service", serve, answers=True)
            with ServiceClient(children.first_line("service", service, 60)["url"]) as client:
                body: dict[str, Any] = {"plan": {}}
                if (truth / "head.obj").is_file():
                    body["head"] = str(truth / "head.obj")
                capture = client.post("/captures", body)
                capture = client.follow_capture(capture["id"], progress, children.check)
        if capture["outcome"] != "completed":
            raise CommandError(f"{self.name}: {capture['outcome']}: {capture['error']}", FAILED)
        return Path(capture["path"]).resolve()


def _content(subject: str | None) -> str | None:
    """The digest of a file, or what is no file as it is."""
    if subject is None or not Path(subject).is_file():
        return subject
    return hashlib.sha256(Path(subject).read_bytes()).hexdigest()
