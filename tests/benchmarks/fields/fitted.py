"""Frames for fields on top of a real fit: inverse rendering of captured frames, nothing emulated.

On a simulated subject's reconstructed strands, or on the capture that Cycles rendered, on its true
strands or on reconstructed ones.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from appearance import InverseRenderingOptions, build_scene
from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.fields.anchors import Places
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.pictures import Pictures
from appearance.inverse_rendering.loop import Monitor, run
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.sun_fit.options import FitOptions
from benchmarks.appearance.cycles import captured_by_cycles
from benchmarks.appearance.hair_inverse import hair_inverse
from benchmarks.appearance.known_subjects import (
    Captured,
    SmallStage,
    known_subject,
    on_reconstructed,
)
from benchmarks.command import LeftOut, cycles_folder, within
from benchmarks.fields.frames import Frames
from benchmarks.subjects import cycles_subject, simulated
from reconstruction import Progress, Strands, read_strands, silent

STAGE = SmallStage(size=24, cameras=8, lights=18, spp=576, judged_spp=576, truth=(12, 48, 48))
CYCLES_PATHS = 96
"""Paths a pixel of Cycles' many pixels."""
OPTIONS = InverseRenderingOptions(effort=Effort(pixels=300, spp=256, max_depth=10))


def captured_of(args: argparse.Namespace) -> tuple[Captured, Strands]:
    """What `args` name: a capture, and the strands that it is fitted on.

    Raises `LeftOut` where a simulated subject has no reconstructed strands.
    """
    strands = read_strands(args.strands) if args.strands else None
    if args.on == "cycles":
        folder = cycles_folder(args.capture)
        subject, _ = cycles_subject(folder)
        captured = captured_by_cycles(folder, args.seed)
        captured = replace(captured, rig=replace(captured.rig, judged_spp=CYCLES_PATHS))
        if strands is None:
            return captured, subject.strands
        scene = build_scene(strands, subject.head, hair=subject.hair, skin=subject.skin)
        mapped = MappedStrands.of(scene, strands, scalp_coordinates(strands, subject.head))
        return replace(captured, mapped=mapped), strands
    if strands is None:
        raise LeftOut("reconstructed strands of the subject are needed: --strands")
    subject = simulated(args.rig, args.subject, args.head, args.seed)
    captured = known_subject("b", subject, STAGE, args.seed)
    return on_reconstructed(captured, strands, subject), strands


def fitted_frames(
    captured: Captured,
    strands: Strands,
    *,
    options: InverseRenderingOptions = OPTIONS,
    seed: int = 0,
    progress: Progress = silent,
) -> tuple[Frames, dict[str, Any]]:
    """The frames with what inverse rendering of `captured` makes of them; and what it found."""
    progress("one colour", 0.0)
    training = captured.training()
    quick = FitOptions(hair_pixels=200, roughness_spp=12, colour_spp=8)
    hair, _ = hair_inverse(captured.mapped.scene, training, options=quick, seed=seed)
    problem = FitProblem(captured.mapped, training, captured.exposure.scale, captured.skin)
    found = run(
        problem,
        HairMaps.of(hair),
        stages=("shared", "spatial"),
        options=options,
        seed=seed,
        monitor=Monitor(within(progress, "inverse rendering")),
    )
    scene = captured.mapped.with_maps(found.maps).with_skin(captured.skin)
    pictures, rendered = [], []
    for k, o in enumerate(captured.views):
        progress(f"view {k}: rendering {len(o.lights)} lights", k / len(captured.views))
        sampling = (captured.rig.judged_spp, (seed << 8) + 31 + 2 * k)
        halves = captured.rig.halves(scene, o.camera, o.single_lights, o.pixels, sampling)
        hits = find_hits(captured.mapped, o.camera, o.pixels, HitOptions(16, seed))
        pictures.append(Pictures(hits, o.single_lights, np.stack(halves), o.radiance, o.valid))
        rendered.append(halves)
    frames = Frames(
        tuple(pictures),
        captured.halves,
        tuple(rendered),
        Places.of(captured.mapped.root_uv),
        captured.exposure.scale,
        captured.held_views,
        captured.held_lights,
        captured.mapped,
        strands,
    )
    mean = found.maps.mean()
    return frames, {"kept": found.kept, **mean.to_dict()}
