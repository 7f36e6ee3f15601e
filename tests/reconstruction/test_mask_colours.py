"""Hair told from skin by light alone, whatever the hair's colour: rendered heads, no example."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from shooting import shoot

from appearance import build_scene
from appearance.render.coverage import coverage
from reconstruction import Camera, Light, Rig, Step
from reconstruction.geometry.lights import dome_positions
from reconstruction.masks import hair_masks
from simulators.frames.responses import MitsubaResponder, Quality
from simulators.subject.drift import Drift
from simulators.subject.subject import make_subject

LIGHTS = 48
LEAST = {"black": 0.8, "brown": 0.75, "red": 0.87, "blond": 0.95, "white": 0.95}
"""Overlaps in the worse of two pictures: .88, .84, .93, .97, .97; .56 with the face as hair."""
ABSORPTION = {
    "black": (3.0, 4.0, 6.0),
    "brown": (0.6, 0.9, 1.6),
    "red": (0.1, 0.5, 1.5),
    "blond": (0.06, 0.12, 0.28),
    "white": (0.01, 0.012, 0.015),
}


@pytest.mark.slow
@pytest.mark.parametrize("colour", ABSORPTION)
def test_no_colour_of_hair_is_taken_for_skin(colour: str, tmp_path: Path) -> None:
    subject = make_subject("wavy", strands=4000)
    subject = replace(subject, hair=replace(subject.hair, sigma_a=ABSORPTION[colour]))
    cameras = tuple(
        Camera.look_at(f"cam_{k}", 96, 96, place, (0, 0, 0.02), 20.0)
        for k, place in enumerate([(0.1, -1.0, 0.1), (0.9, -0.4, 0.2)])
    )
    lights = tuple(
        Light(f"light_{k:02d}", place, (8.0, 8.0, 8.0))
        for k, place in enumerate(dome_positions(LIGHTS, 1.2, -50.0))
    )
    rig = Rig("colours", cameras, lights, ())
    steps = [Step(0, "dark", 0.02, 0.0)]
    steps += [Step(k + 1, "olat", 0.02, light=light.name) for k, light in enumerate(lights)]
    responder = MitsubaResponder(rig, subject, Drift(1, 0.0, 0), Quality.scaled(16), 0)
    masks = hair_masks(shoot(tmp_path / "capture", rig, responder, steps), None, None)
    scene = build_scene(subject.strands, subject.head, hair=subject.hair)
    for camera in cameras:
        share = coverage(scene, camera, 64)
        hair = (share["hair"] + share["head"] > 0.1) & (share["hair"] >= share["head"])
        found = masks[camera.name].hair
        overlap = (found & hair).sum() / (found | hair).sum()
        assert overlap > LEAST[colour]
