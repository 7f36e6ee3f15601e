"""Lamps from mirror and diffuse spheres: against the truth, and where spheres say too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reconstruction import Capture, Rig
from reconstruction.calibration.boards import CalibrationError
from reconstruction.calibration.shading import Shading, refine_centres, shaded_light
from reconstruction.calibration.solve_lights import Glint, mirrored_lights
from reconstruction.calibration.sphere_captures import gather_shading, glints_of
from reconstruction.calibration.spheres import find_highlight, mirrored
from simulators.subject.props import SphereProp, reflection

PLACES = ((0.0, 0.01, 0.02), (0.03, -0.05, -0.03))


def names(rig: Rig) -> list[str]:
    return [x.name for x in rig.lights]


@pytest.fixture(scope="module")
def shadings(
    true_rig: Rig, nominal_rig: Rig, diffuse_captures: list[Capture]
) -> dict[str, Shading]:
    """What the diffuse sphere shows to cameras in their true places."""
    found = gather_shading(diffuse_captures, true_rig.cameras, 0.06, 0.8, names(true_rig))
    return refine_centres({x.name: x for x in nominal_rig.lights}, found)


@pytest.fixture(scope="module")
def glints(true_rig: Rig, mirror_captures: list[Capture]) -> list[Glint]:
    """What the mirror shows to cameras in their true places."""
    return glints_of(mirror_captures, true_rig.cameras, names(true_rig))


def test_shading_gives_position_to_one_and_intensity_to_two_percent(
    true_rig: Rig, nominal_rig: Rig, shadings: dict[str, Shading]
) -> None:
    for true in true_rig.lights:
        light = shaded_light(nominal_rig.light(true.name), shadings[true.name])
        off = float(np.linalg.norm(light.light.position - true.position))
        assert off < 0.01 * 1.2, true.name
        assert off < 4 * light.deviation, true.name
        assert light.light.intensity == pytest.approx(true.intensity, rel=0.02)


def test_shading_corrects_where_outlines_put_the_sphere(
    true_rig: Rig, diffuse_captures: list[Capture], shadings: dict[str, Shading]
) -> None:
    by_outline = gather_shading(diffuse_captures, true_rig.cameras, 0.06, 0.8, ["lamp_0"])
    before = np.linalg.norm(by_outline["lamp_0"].centres - PLACES, axis=1)
    after = np.linalg.norm(shadings["lamp_0"].centres - PLACES, axis=1)
    assert (after < 0.5 * before).all()


@pytest.mark.parametrize("radius", [0.05, 0.059, 0.06, 0.061, 0.07])
def test_wrong_sphere_radius_gives_a_warning(
    true_rig: Rig, diffuse_captures: list[Capture], radius: float
) -> None:
    """The spheres' radius is 60 mm: of 50, the lamps would be three times as far as they are."""
    warnings: list[str] = []
    gather_shading(diffuse_captures, true_rig.cameras, radius, 0.8, ["lamp_0"], warnings.append)
    assert len(warnings) == (0 if radius == 0.06 else 2)
    for text, capture in zip(warnings, diffuse_captures, strict=False):
        observed = float(text.split("a radius of ")[1].split(" mm")[0])
        assert observed == pytest.approx(60, abs=1.0)
        assert f"{capture.path}: " in text
        assert f"expected {1e3 * radius:g} mm" in text
    warnings.clear()  # one camera tells size or distance
    gather_shading(diffuse_captures, true_rig.cameras[:1], radius, 0.8, ["lamp_0"], warnings.append)
    assert warnings == []


def test_a_mirror_sharpens_what_shading_says(
    true_rig: Rig, nominal_rig: Rig, shadings: dict[str, Shading], glints: list[Glint]
) -> None:
    nominal = {x.name: x for x in nominal_rig.lights}
    known = {n: shaded_light(nominal[n], s) for n, s in shadings.items()}
    lights, centres, rms = mirrored_lights(nominal, glints, 0.05, known)
    assert len(glints) == 2 * 3 * 4
    assert rms < 0.5
    assert np.linalg.norm(centres[0] - (0.0, 0.01, 0.02)) < 1e-3
    for true in true_rig.lights:
        light = lights[true.name]
        assert np.linalg.norm(light.light.position - true.position) < 0.01 * 1.2
        assert light.deviation <= 1.1 * known[true.name].deviation


def test_a_mirror_alone_says_where_lights_are_when_its_places_are_wide_apart(
    true_rig: Rig, nominal_rig: Rig
) -> None:
    rng = np.random.default_rng(0)
    places = np.array([(0.0, -0.15, 0.1), (0.05, 0.15, 0.1), (0.0, 0.15, -0.1), (0, -0.15, -0.1)])
    observed = []
    for k, place in enumerate(places):
        for camera in true_rig.cameras:
            for light in true_rig.lights:
                at = reflection(camera.center, light.position[None], place, 0.05)
                pixel = camera.project(at)[0][0] + 0.05 * rng.standard_normal(2)
                image = np.zeros((camera.height, camera.width))
                image[tuple(np.rint(pixel).astype(int)[::-1])] = 1.0
                spot = find_highlight(image, np.zeros_like(image, bool))
                assert spot is not None
                spot = replace(spot, pixel=pixel, deviation=0.05)
                observed.append(Glint(light.name, camera, k, spot))
    nominal = {x.name: x for x in nominal_rig.lights}
    lights, _, _ = mirrored_lights(nominal, observed, 0.05, {})
    for true in true_rig.lights:
        assert np.linalg.norm(lights[true.name].light.position - true.position) < 0.01 * 1.2
        assert lights[true.name].intensity_deviation is None


@pytest.mark.slow
def test_one_place_in_one_pixel_leaves_the_distance_undetermined(
    nominal_rig: Rig, glints: list[Glint]
) -> None:
    one = [g for g in glints if g.sphere == 0]
    lights, _, _ = mirrored_lights({x.name: x for x in nominal_rig.lights}, one, 0.05, {})
    assert lights == {}


def test_cameras_in_one_place_cannot_say_where_a_mirror_is(
    true_rig: Rig, nominal_rig: Rig, glints: list[Glint]
) -> None:
    own = [g for g in glints if g.camera.name == "cam_0"]
    twice = own + [replace(g, camera=replace(g.camera, name="copy")) for g in own]
    with pytest.raises(CalibrationError, match="mirror sphere 1: no highlight is visible from"):
        mirrored_lights({x.name: x for x in nominal_rig.lights}, twice, 0.05, {})


def test_a_saturated_highlight_gives_a_warning_and_weighs_less() -> None:
    image = np.zeros((40, 40))
    image[18:23, 10:15] = 4.0
    spot = find_highlight(image, image >= 4.0)
    assert spot is not None
    assert spot.saturated
    assert spot.pixel == pytest.approx([12, 20])
    sharp = find_highlight(image, np.zeros_like(image, bool))
    assert sharp is not None
    assert spot.deviation > 5 * sharp.deviation


def test_a_light_behind_the_sphere_raises_an_error(
    true_rig: Rig, nominal_rig: Rig, shadings: dict[str, Shading]
) -> None:
    dark = shadings["lamp_0"]
    dark = replace(dark, radiance=np.zeros_like(dark.radiance))
    with pytest.raises(CalibrationError, match=r"light lamp_0: it lights 0 visible pixels"):
        shaded_light(nominal_rig.light("lamp_0"), dark)


def test_light_that_dark_frames_hold_does_no_harm(
    true_rig: Rig, nominal_rig: Rig, shoot_prop: object
) -> None:
    steps = [
        {"kind": "dark", "exposure": 0.02, "level": 0.0},
        {"kind": "all_on", "exposure": 0.02, "level": 0.4},
        {"kind": "olat", "exposure": 0.02, "light": "lamp_1"},
    ]
    prop = SphereProp(np.array((0.0, 0.01, 0.02)), 0.06, 0.8)
    capture = shoot_prop(prop, steps, ambient=0.3)  # type: ignore[operator]
    found = gather_shading([capture], true_rig.cameras, 0.06, 0.8, ["lamp_1"])
    shading = refine_centres({"lamp_1": nominal_rig.light("lamp_1")}, found)["lamp_1"]
    light = shaded_light(nominal_rig.light("lamp_1"), shading)
    true = true_rig.light("lamp_1")
    assert np.linalg.norm(light.light.position - true.position) < 0.02 * 1.2
    assert light.light.intensity == pytest.approx(true.intensity, rel=0.03)


def test_mirrors_reflect_at_equal_angles_in_estimate_and_simulation() -> None:
    rng = np.random.default_rng(3)
    eye, centre = np.array((0.9, 0.1, 0.0)), np.array((0.02, 0.0, 0.01))
    lights = rng.standard_normal((50, 3))
    lights *= 1.2 / np.linalg.norm(lights, axis=1, keepdims=True)
    shown = reflection(eye, lights, centre, 0.05)
    visible = np.isfinite(shown).all(axis=1)
    assert visible.sum() > 30
    n = (shown - centre)[visible] / 0.05
    to_eye, to_lamp = (
        v / np.linalg.norm(v, axis=1, keepdims=True) for v in (eye - shown, lights - shown)
    )
    cosines = [(n * v[visible]).sum(axis=1) for v in (to_eye, to_lamp)]
    assert cosines[0] == pytest.approx(cosines[1], abs=1e-9)
    steep = np.zeros_like(visible)
    steep[visible] = cosines[0] > 0.15
    count = int(steep.sum())
    eyes, centres = (np.broadcast_to(v, (count, 3)) for v in (eye, centre))
    assert mirrored(eyes, lights[steep], centres, 0.05) == pytest.approx(shown[steep], abs=1e-7)
