"""The cost of `reconstruct`, estimated from a short probe of the capture on this machine.

Reading frames, searching rows of a sweep and filter banks are timed on samples; stages that depend
on the hair alone come from a table of seconds per unit, scaled by the time of a reference task.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from reconstruction.capture.folder import Capture
from reconstruction.capture.frame_cache import cache_bytes
from reconstruction.capture.records import CaptureError, MissingFrame, Step, StepKind
from reconstruction.capture_scale import CaptureScale
from reconstruction.geometry.cameras import Camera
from reconstruction.head.capture_head import HeadPoints, digitised_points
from reconstruction.head.lit_skin import FEWEST_LIGHTS as FEWEST_LIGHTS_OF_SKIN
from reconstruction.head.lit_skin import MOST_LIGHTS
from reconstruction.images.orientation import responses
from reconstruction.light_codes.codes import WORD
from reconstruction.light_codes.line_strands import MOST_LINES
from reconstruction.light_codes.search import STEP_PIXELS
from reconstruction.light_planes.peaks import PER_PIXEL, Scan
from reconstruction.methods import Method
from reconstruction.pipeline import FINE_PIXEL, without
from reconstruction.reconstruct_options import LogGaborBank, ReconstructOptions
from reconstruction.report.report import Progress, silent, usable_cores
from reconstruction.stages import method_for
from reconstruction.tangents.estimate import CANDIDATES, LIGHT_GROUPS, MOST_POINTS
from reconstruction.tangents.point_lines import WIDEST_PIXEL
from reconstruction.tangents.reflection import FEWEST_LIGHTS

KNOWN_TASK = 0.0155
"""Seconds of the reference task, a filter bank on 256² pixels, on the machine of the table."""

SWEPT, UNSWEPT = 2.0, 8.0
"""Depth of a surface in cells of `MeasureOptions.thin`: triangulated, and on a hull."""

DEPTHS = 1.6e-6
"""Seconds of line stereo per pixel and neighbour on two cores, of which three fifths scale with the
number of depths, 0.5 mm apart."""

HEAD_FIT = 2.0  # seconds, whatever the capture: points are thinned
ROWS = 12  # of a sweep that the probe searches, in each of three places
SKIN_LIGHTS = 96  # lights to classify hair and skin: up to twice as many are read
GB = 1e9


@dataclass(frozen=True)
class StageCost:
    """Expected `seconds` of a stage, of which the share `measured` is the probe's and the rest the
    table's, and the process's `peak_gb`."""

    name: str
    seconds: float
    peak_gb: float
    measured: float


@dataclass(frozen=True)
class Estimate:
    """Cost of a reconstruction: `stages` in order, `frames` read, `disk_gb` written, `working_gb`
    of temporary files; `scale` is what it resolves, for a head at the origin."""

    method: Method
    stages: tuple[StageCost, ...]
    frames: int
    disk_gb: float
    working_gb: float
    scale: CaptureScale

    @property
    def seconds(self) -> float:
        """Of all stages."""
        return sum(s.seconds for s in self.stages)

    @property
    def peak_gb(self) -> float:
        """Largest of all stages."""
        return max(s.peak_gb for s in self.stages)


def estimate(
    capture: Capture,
    *,
    method: Method = "auto",
    options: ReconstructOptions = ReconstructOptions(),
    progress: Progress = silent,
) -> Estimate:
    """Cost of `reconstruct(capture, model, method=method, options=options)` on this idle machine.

    `hairstage bench large` shows its error. Raises `CaptureError` for an unreadable frame, and for
    held-out cameras as `reconstruct` does.
    """
    capture = capture.view(undistorted=True)
    probe = _Probe(without(capture, options.held_out), options, progress)
    stages = probe.stages(method)
    method = method_for(capture) if method == "auto" else method
    progress("probed", 1.0)
    frames = sum(capture.has(s, c.name) for s in capture.steps for c in capture.rig.cameras)
    each = 1e-6 if capture.of_kind("scanline") else 3.6e-6
    disk_gb, working_gb = 0.01 + each * probe.points, cache_bytes(capture) / GB
    return Estimate(method, tuple(stages), frames, disk_gb, working_gb, probe.scale)


@dataclass(frozen=True, eq=False)
class _Probe:
    """Measures the cost of a capture; sizes are those of the images that are processed."""

    capture: Capture
    options: ReconstructOptions
    progress: Progress

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self.capture.rig.cameras

    @cached_property
    def pixels(self) -> float:
        """Of one camera, the mean."""
        return float(np.mean([c.width * c.height for c in self.cameras]))

    @property
    def shown(self) -> float:
        """Pixels of all cameras together."""
        return self.pixels * len(self.cameras)

    @cached_property
    def lights(self) -> int:
        """Images of a camera that give directions: under single lights, else a lit one."""
        return len(self.capture.olat_lights()) or int(bool(self.capture.without_single_lights()))

    @property
    def kind(self) -> StepKind:
        """The kind of these images."""
        return next((s.kind for s in self.capture.without_single_lights()), "olat")

    @cached_property
    def slowness(self) -> float:
        """Run time on this machine over that on the table's."""
        image = np.random.default_rng(0).random((256, 256), np.float32)
        bank = LogGaborBank(wavelength=6.0, count=24, spread=1.0)
        responses(bank, image)  # makes its filters
        return _seconds(lambda: responses(bank, image), 3) / KNOWN_TASK

    def frames(self, *kinds: StepKind) -> int:
        """Number of frames of these kinds, of all cameras."""
        steps = [s for k in kinds for s in self.capture.of_kind(k)]
        return sum(self.capture.has(s, c.name) for s in steps for c in self.cameras)

    def a_frame(self, kind: StepKind, number: int = 0) -> tuple[Step, str]:
        """One of that kind, of the cameras in turn. Raises `MissingFrame`."""
        steps, names = self.capture.of_kind(kind), [c.name for c in self.cameras]
        for k in range(len(steps)):
            step = steps[(k + (2 * number + 1) * len(steps) // 8) % len(steps)]
            for name in names[number % len(names) :] + names[: number % len(names)]:
                if self.capture.has(step, name):
                    return step, name
        raise MissingFrame(f"{self.capture.path}: no frame of the kind {kind}")

    def reading(self, kind: StepKind) -> float:
        """Seconds to read a frame of that kind, after others of its camera."""
        total = 0.0
        for number in range(2):
            _, camera = self.a_frame(kind, number)
            view = replace(self, capture=self.capture.view(cameras=[camera]))
            first, then = view.a_frame(kind, number), view.a_frame(kind, number + 2)
            self.capture.frame(*first)
            total += _seconds(partial(self.capture.frame, *then))
        return total / 2

    @cached_property
    def read(self) -> float:
        """Seconds to read one of the images that give directions, 0 without any."""
        self.progress("reading frames", 0.1)
        return self.reading(self.kind) if self.frames(self.kind) else 0.0

    @property
    def again(self) -> float:
        """Seconds to read it once more: a reduced view caches its frames."""
        return self.read if self.capture.reduced_by == 1 else 2e-8 * self.pixels

    @cached_property
    def hair(self) -> float:
        """Pixels of all cameras on the hair, by its masks, or else on the subject."""
        self.progress("finding the subject", 0.0)
        shares = []
        for camera in self.cameras[:: max(1, len(self.cameras) // 4)]:
            if (mask := self.capture.mask(camera.name)) is not None:
                shares.append(mask.mean())
                continue
            view = replace(self, capture=self.capture.view(cameras=[camera.name]))
            kinds: list[StepKind] = ["all_on", "olat", "pattern", "tracking"]
            kind = next((k for k in kinds if view.frames(k)), None)
            if kind is None:
                continue
            some = {view.a_frame(kind, n) for n in range(4 if kind == "olat" else 1)}
            image = np.sum([self.capture.frame(*f).mean(axis=-1) for f in some], axis=0)
            shares.append((image > 0.05 * np.percentile(image, 99.5)).mean())
        share = float(np.mean(shares or [0.3]))
        if share == 0:
            raise CaptureError(f"{self.capture.path}: no camera shows hair: check masks and frames")
        return share * self.shown

    @cached_property
    def pixel(self) -> float:
        """Metres that a pixel spans at the origin."""
        return float(np.median([np.linalg.norm(c.center) / c.K[0, 0] for c in self.cameras]))

    @cached_property
    def scale(self) -> CaptureScale:
        """The lengths that the capture resolves."""
        return CaptureScale.of_pixel(self.pixel, self.options)

    @cached_property
    def points(self) -> float:
        """Points with measured directions: one per two pixels, until the surface is saturated."""
        sphere = 4 * self.hair / len(self.cameras) * self.pixel**2  # of the same outline
        deep = SWEPT if self.capture.of_kind("scanline") else UNSWEPT
        most = deep * sphere / self.scale.thin**2
        every = most * (1 - float(np.exp(-0.7 * self.hair / most)))
        return every if self.options.measure.thin else min(every, MOST_POINTS)

    @cached_property
    def volume(self) -> float:
        """Millions of voxels of the envelope: a ball of the outline, its shell for a sweep."""
        share = 0.3 if self.capture.of_kind("scanline") else 1.0
        outline = self.hair / len(self.cameras) * self.pixel**2
        return share * 0.75e-6 * outline**1.5 / self.scale.grid**3

    def stages(self, requested: Method) -> list[StageCost]:
        """The stages in the order of the report."""
        method = method_for(self.capture) if requested == "auto" else requested
        slow, n, hair, lights = self.slowness, self.points, self.hair, self.lights
        base = 0.3  # of the process, later with a sweep's points
        out: list[StageCost] = []

        def add(name: str, measured: float = 0.0, table: float = 0.0, gb: float = 0.0) -> None:
            seconds = measured + slow * table
            share = measured / seconds if seconds > 0 else 0.0
            out.append(StageCost(name, seconds, base + gb, share))

        if self.capture.plan.get("import"):
            add("import")
        if self.capture.lenses:
            add("lenses")
        known = self.capture.head is not None
        points: HeadPoints | str | None = self.options.scalp_points
        if not known and points is None:
            points = digitised_points(self.capture, None)
        if points is not None:
            add("head", table=HEAD_FIT)
            known = True
        if requested == "auto":
            add("method")
        sweep = self.frames("scanline")
        rows, stripes = 0.0, 0.0
        if sweep:
            rows, stripes = sweep * self.row(), 0.7 * hair * len(self.capture.rig.projectors)
        add("triangulation", rows, 3e-5 * stripes, (150 * self.pixels + 565 * stripes) / GB)
        if sweep:
            tracking = self.frames("tracking")
            read = tracking * self.reading("tracking") if tracking else 0.0
            each = 0.02 + 6e-6 * min(hair / len(self.cameras), 12_000.0)
            add("motion", read, tracking * each, (300 * self.pixels + 560 * hair) / GB)
            base += 560 * hair / GB
        looked = min(lights, 1.5 * SKIN_LIGHTS) * len(self.cameras)
        lit = len(self.cameras) if self.frames("all_on") else self.frames("olat")
        more = looked + (0 if known else lit)
        add(
            "masks",
            lit * self.read + more * (self.read if self.frames("all_on") else self.again),
            looked * 1.7e-7 * self.pixels,
            (8 * min(lights, 1.5 * SKIN_LIGHTS) / len(self.cameras) + 40) * hair / GB,
        )
        if method in ("photometric", "lmvs"):
            _, lines = self._line_stereo(add, method)
            add("strands", table=3e-5 * lines, gb=7e-6 * lines)
            return out
        if method != "hull" and not known:
            add("head", table=HEAD_FIT)
        elif not known and lights >= FEWEST_LIGHTS_OF_SKIN:
            add("head", 3 * min(lights, MOST_LIGHTS) * self.again, HEAD_FIT)
        add("scale")
        volume = self.volume
        bare = not known and method == "hull"  # a hull without a head, filled 12 mm deep
        each = 0.1 if bare else 0.5
        add("envelope", table=2 + each * len(self.cameras) * volume, gb=0.3 * volume)
        if lights:
            self._orientation(add)
        found, lines = 0.0, 0.0
        if method == "hull":
            fine = lights > 0 and self.pixel <= FINE_PIXEL
            place = len(out)
            if fine:
                found, lines = self._line_stereo(add, method)
            add("line stereo", table=2e-5 * lines, gb=5e-7 * hair if fine else 0.0)
            out.insert(place, out.pop())
        else:
            add("surface", table=1.2e-4 * n if sweep else 0.0, gb=2e-6 * n if sweep else 0.0)
            if method == "fused":
                found, lines = self._line_stereo(add, method)
        grown = (3.0 if bare else 1.2) * volume + 7e-6 * n + 5e-6 * lines
        if sweep:
            grown = 0.6 + 5e-6 * n
        traced = (30 if bare else 16) * volume + (6e-5 if sweep else 1.2e-4) * n + 1e-4 * lines
        add("field", table=7.5 * volume + 2e-6 * (n + found), gb=1.2 * volume)
        add("strands", table=traced, gb=grown)
        if bare:
            return out
        refined = (2.0 + 3.3e-4 * n, 0.3 + 6e-6 * n) if sweep else (0.0, 0.0)
        last = (1.5 + 3.3e-5 * n + 1.2e-4 * lines, 0.8 * grown)
        add("refinement", 0.0, *refined)
        if method != "hull":
            add("hidden", table=(sweep > 0 and self.pixel <= WIDEST_PIXEL) * (3.0 + 3e-4 * n))
        add("roots", 0.0, *((0.5 + 1.5e-5 * n, 0.2 + 5e-6 * n) if sweep else last))
        return out

    def _orientation(self, add: Callable[[str, float, float, float], None]) -> None:
        lights, n, bank = self.lights, self.points, self.options.measure.bank
        groups = min(LIGHT_GROUPS, lights) * len(self.cameras)
        measured = self.frames(self.kind) * self.again + groups * self.filtering(bank)
        reads = lights if lights >= FEWEST_LIGHTS else 0
        table = n * ((2.2e-4 if reads else 0.9e-4) + 1.4e-6 * reads)
        sweep = bool(self.capture.of_kind("scanline")) and self.pixel <= WIDEST_PIXEL
        table += sweep * (2.9e-4 * n + (14.0 if reads else 1.5) * min(n / 3000, 1.0))
        images = self.pixels * (5 * lights + 8 * min(LIGHT_GROUPS, lights) + 8 * bank.count + 60)
        scores, observed = 4 * CANDIDATES * n, (0.7 + 0.3 * len(self.cameras)) * n * reads * 5
        part = 0.35e9 * min(n / 2e4, 1.0)  # of scores being decided
        times = (8 if reads else 4.4) + 2 * sweep  # halves of each kind, sums and averages
        add("orientation", measured, table, max(images, times * scores + part + observed) / GB)

    def _line_stereo(
        self, add: Callable[[str, float, float, float], None], method: Method
    ) -> tuple[float, float]:
        """Add its stages; returns the numbers of agreed segments and of traced lines."""
        cameras, lights, hair = len(self.cameras), self.lights, self.hair
        frames, bank = self.frames(self.kind), self.options.light_codes.bank
        measured = frames * (self.again + self.filtering(bank))
        add(
            "lightcodes",
            measured,
            1.2e-7 * frames * self.pixels,
            self.pixels * (18 * lights + 400) / GB,
        )
        near = min(self.options.light_codes.search.neighbours, max(cameras // 2, 1))
        step = min(self.options.light_codes.search.step, STEP_PIXELS * self.pixel)
        depths = 0.4 + 0.6 * 5e-4 / step
        words = -(-lights // WORD)  # of a lightcode
        cores = usable_cores()
        each = DEPTHS * (1 + 0.5 * words) * depths * 2 / cores
        add("depth", 0.0, each * hair * near, 2.5e-7 * hair)
        lines = 0.42 * hair * float(np.exp(-self.pixel / 1e-3))  # wide pixels agree less
        if method == "lmvs":
            lines *= 0.03
        found, lines = lines, min(lines, MOST_LINES)
        add("segments", 0.0, (4e-7 + 5e-8 / cores * cameras) * hair, 5e-7 * hair)
        add("connection", 0.0, 5e-6 * found + 8e-5 * lines, 5e-7 * hair)
        return found, lines

    def row(self) -> float:
        """Seconds of one row of a sweep in one camera, from rows in three places."""
        self.progress("searching rows", 0.3)
        step, camera = self.a_frame("scanline")
        steps = [s for s in self.capture.of_kind("scanline") if s.projector == step.projector]
        scan = Scan(self.capture, camera, {s.row: s for s in steps}, len(steps), PER_PIXEL)
        rows = [s.row for s in steps if s.row is not None]
        starts = np.linspace(0, max(len(rows) - ROWS, 0), 5)[1:-1].astype(int)
        some = [rows[start : start + ROWS] for start in starts]
        scan.push(rows[0])  # also reads the dark frame

        def searched() -> None:
            for row in (row for part in some for row in part):
                scan.push(row)

        return _seconds(searched) / sum(map(len, some))

    def filtering(self, bank: LogGaborBank) -> float:
        """Seconds of a filter bank on one image."""
        self.progress("filtering", 0.6)
        step, camera = self.a_frame(self.kind)
        image = self.capture.frame(step, camera).mean(axis=-1)
        few = replace(bank, count=min(bank.count, 8))  # large images take minutes
        _ = responses(few, image)
        return _seconds(lambda: responses(few, image)) * bank.count / few.count


def _seconds(task: Callable[[], object], times: int = 1) -> float:
    """The least seconds of `times` runs of `task`."""
    best = np.inf
    for _ in range(times):
        start = time.perf_counter()
        task()
        best = min(best, time.perf_counter() - start)
    return float(best)
