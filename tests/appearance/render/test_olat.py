"""OLAT images against closed forms, Mitsuba's own path integrator, and Blender Cycles."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from benchmarks.renderers.path_reference import PathReference

from appearance import HairAppearance, build_scene, render_olat
from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.render import olat
from appearance.render.coverage import covered_pixels
from appearance.render.olat import render_direct, render_indirect
from appearance.scene.hair_appearance import DiffuseHair
from appearance.scene.hair_scene import SHINE_EXPONENT, FaceMaterials
from reconstruction import Camera, Light, Strands, read_exr

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)


@pytest.fixture(scope="module")
def tufted(small):
    """A tuft of hair on a plane, a camera, and lights all around."""
    return build_scene(small.tuft(), small.plane(), hair=HAIR), small.camera(), small.lights()


def test_lambertian_radiance_is_albedo_over_pi_times_irradiance(small):
    albedo = np.array([0.35, 0.25, 0.2])
    scene = build_scene(small.no_hair, small.plane(), hair=HAIR, skin=albedo)
    camera = Camera.look_at("cam", 32, 24, (0.2, -0.4, 0.6), (0.02, 0.01, 0), 20, roll_deg=30)
    light = Light("near", np.array([0.1, 0.15, 0.3]), np.array([8.0, 4.0, 2.0]))
    image = render_olat(scene, camera, [light], spp=64, max_depth=3, thrift=0)[0]
    column, row = np.meshgrid(np.arange(32), np.arange(24))
    rays = camera.rays(np.stack([column, row], -1))
    hit = camera.center - rays * (camera.center[2] / rays[..., 2])[..., None]
    towards = light.position - hit
    d2 = (towards**2).sum(-1)
    expected = albedo / np.pi * light.intensity * (towards[..., 2] / d2**1.5)[..., None]
    np.testing.assert_allclose(image, expected, rtol=3e-3)


def test_faces_have_the_albedo_and_the_blinn_phong_highlight_of_their_own(small):
    """A plane of two triangles, the first matte, the second also shiny."""
    albedo, shine = np.array([[0.5, 0.3, 0.1], [0.1, 0.2, 0.4]]), np.array([0.0, 0.3])
    materials = FaceMaterials(albedo, shine)
    scene = build_scene(small.no_hair, small.plane(), hair=HAIR, materials=materials)
    camera = Camera.look_at("cam", 32, 24, (0.2, -0.4, 0.6), (0.02, 0.01, 0), 20, roll_deg=30)
    light = Light("near", np.array([-0.15, 0.35, 0.5]), np.array([8.0, 4.0, 2.0]))
    image = render_olat(scene, camera, [light], spp=64, max_depth=3, thrift=0)[0]
    rays = camera.rays(np.stack(np.meshgrid(np.arange(32), np.arange(24)), -1))
    hit = camera.center - rays * (camera.center[2] / rays[..., 2])[..., None]
    second = hit[..., 1] > hit[..., 0]
    clear = np.abs(hit[..., 1] - hit[..., 0]) > 0.02
    towards = light.position - hit
    d2 = (towards**2).sum(-1)
    half = towards / np.sqrt(d2)[..., None] - rays
    cosine = half[..., 2] / np.linalg.norm(half, axis=-1)
    n = SHINE_EXPONENT
    lobe = shine[second.astype(int)] * (n + 8) / (8 * np.pi) * cosine**n
    reflected = albedo[second.astype(int)] / np.pi + lobe[..., None]
    expected = reflected * light.intensity * (towards[..., 2] / d2**1.5)[..., None]
    assert lobe.max() > 0.3
    assert clear[second].any()
    assert clear[~second].any()
    np.testing.assert_allclose(image[clear], expected[clear], rtol=5e-3)


SPENDING = {
    "defaults": {},
    "all lights, all shadow rays": {"thrift": 0},
    "few lights, few shadow rays": {"first_lights": 2, "deep_lights": 1, "thrift": 8},
    "many tiles": {"memory": 1 << 16},
}


@pytest.fixture(scope="module")
def path_means(tufted):
    """Means (4 runs, lights, 3) by Mitsuba's path, light by light."""
    scene, camera, lights = tufted
    path, pixels = PathReference(scene, max_depth=8), covered_pixels(scene, camera)
    runs = [path.render(camera, lights, pixels, spp=128, seed=s).mean(1) for s in range(4)]
    return np.array(runs, float)


@pytest.mark.usefixtures("mitsubas_shadows")
@pytest.mark.parametrize("how", SPENDING, ids=str)
def test_agrees_with_mitsubas_path_however_rays_are_spent(tufted, path_means, how):
    scene, camera, lights = tufted
    pixels = covered_pixels(scene, camera)
    ours = np.array(
        [
            render_olat(
                scene, camera, lights, spp=128, max_depth=8, seed=s, pixels=pixels, **SPENDING[how]
            ).mean(1)
            for s in range(4)
        ],
        float,
    )
    ratio = ours.mean(0) / path_means.mean(0)
    error = np.sqrt(
        ours.var(0, ddof=1) / 4 / ours.mean(0) ** 2
        + path_means.var(0, ddof=1) / 4 / path_means.mean(0) ** 2
    )
    assert error.max() < 0.02
    # four runs make a rough error estimate: Student's t with about 6 degrees of freedom
    assert (np.abs(ratio - 1) < np.maximum(5 * error, 0.01)).all()


def test_diffuse_fibres_agree_with_mitsubas_path(tufted):
    scene, camera, lights = tufted
    scene = scene.with_hair(DiffuseHair((0.7, 0.5, 0.2)))
    pixels = covered_pixels(scene, camera)
    ours = render_olat(scene, camera, lights, spp=256, max_depth=6, pixels=pixels).mean(1)
    path = PathReference(scene, max_depth=6).render(camera, lights, pixels, spp=128).mean(1)
    np.testing.assert_allclose(ours, path, rtol=0.015)


def test_black_and_white_hair_stay_finite(tufted):
    scene, camera, lights = tufted
    black, white = (
        render_olat(
            scene.with_hair(HairAppearance((s, s, s), 0.3, 0.3)), camera, lights, spp=8, seed=1
        )
        for s in (1e4, 0.0)
    )
    assert np.isfinite(white).all()
    assert np.isfinite(black).all()
    assert 0 < black.mean() < white.mean()


def test_a_camera_that_sees_nothing_gets_black_images(tufted):
    scene, _, lights = tufted
    away = Camera.look_at("away", 8, 6, (0, 0, 1.0), (0, 0, 2.0), 20)
    image = render_olat(scene, away, lights)
    assert image.shape == (3, 6, 8, 3)
    assert not image.any()


def test_lights_superpose(tufted):
    """Two lights at one place are one light of their sum, path by path."""
    scene, camera, lights = tufted
    here = lights[0].position
    parts = [Light("a", here, np.array([8.0, 1.0, 0.0])), Light("b", here, np.array([1, 2, 3.0]))]
    whole = [Light("ab", here, np.array([9.0, 3.0, 3.0]))]
    # an equal number of random draws keeps the paths the same: as many lights in both calls
    two = render_olat(scene, camera, parts, spp=4, thrift=0, seed=5, max_depth=1)
    one = render_olat(scene, camera, whole * 2, spp=4, thrift=0, seed=5, max_depth=1)
    np.testing.assert_allclose(two.sum(0), one[0], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("watts", [1e-20, 1e22])
def test_light_of_any_strength_is_linear(tufted, watts):
    """Its squares are no float32: of bright lights no shadow ray was cast, all was black."""
    scene, camera, lights = tufted
    usual = replace(lights[0], intensity=np.ones(3))
    strong = replace(usual, intensity=np.full(3, watts))
    one, other = (render_olat(scene, camera, [x], spp=4, seed=2) for x in (usual, strong))
    assert one.any()
    np.testing.assert_allclose(other / watts, one, rtol=1e-3, atol=1e-6)


def test_lights_that_overflow_are_refused(tufted):
    scene, camera, lights = tufted
    blinding = replace(lights[0], name="sun", intensity=np.full(3, 1e36))
    with pytest.raises(ValueError, match=r"^sun: .* W/sr cannot be rendered"):
        render_olat(scene, camera, [lights[1], blinding])


@pytest.mark.slow
def test_indirect_light_is_what_direct_light_lacks(small, tufted):
    """A plane cannot see itself: it has none."""
    scene, camera, lights = tufted
    pixels = covered_pixels(scene, camera)
    direct, whole = (
        render_olat(scene, camera, lights, spp=256, max_depth=n, seed=2, pixels=pixels)
        for n in (1, 4)
    )
    indirect = render_indirect(scene, camera, lights, pixels, spp=256, max_depth=4, seed=1)
    np.testing.assert_allclose((direct + indirect).mean((1, 2)), whole.mean((1, 2)), rtol=0.02)
    flat = build_scene(small.no_hair, small.plane(), hair=HAIR)
    assert not render_indirect(flat, camera, lights, pixels, spp=4, max_depth=4).any()


@pytest.mark.parametrize(
    ("light", "spp", "noise", "colours"),
    [
        pytest.param(
            partial(render_indirect, max_depth=6), 64, 0.75, False, marks=pytest.mark.slow
        ),
        (render_direct, 36, 0.6, False),
        (render_direct, 36, 0.6, True),
    ],
)
def test_fibres_that_scatter_the_mean_of_a_part_of_their_width(
    small, monkeypatch, light, spp, noise, colours
):
    """Beside fibres that scatter as at the hit: the same light, and less noise."""
    strands = small.tuft()
    dense = replace(strands, radius=3 * strands.radius)
    scene = build_scene(dense, small.plane(), hair=HAIR)
    if colours:
        absorption = np.random.default_rng(0).uniform(0.05, 1, (1, len(dense), 3))
        maps = HairMaps.each(HAIR, absorption)
        scene = MappedStrands.alone(scene, dense).with_maps(maps)
    camera, lights = small.camera(), small.lights()
    pixels = covered_pixels(scene, camera)

    def pictures():
        return np.stack(
            [light(scene, camera, lights, pixels, spp=spp, seed=s, thrift=0) for s in range(8)]
        )

    width = pictures()
    monkeypatch.setattr("appearance.bsdf.lobes.OFFSETS", 1)
    point = pictures()
    assert width.mean() == pytest.approx(point.mean(), rel=0.006)
    np.testing.assert_allclose(width.mean((0, 2)), point.mean((0, 2)), rtol=0.025)
    assert width.var(axis=0, ddof=1).mean() < noise * point.var(axis=0, ddof=1).mean()


def test_same_seed_same_bytes(tufted):
    scene, camera, lights = tufted
    a, b, other = (render_olat(scene, camera, lights, spp=8, seed=s) for s in (3, 3, 4))
    assert a.tobytes() == b.tobytes()
    assert (a != other).any()


@pytest.mark.parametrize("spp", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_pixels_of_a_rendering_have_independent_noise(tufted, spp):
    """Differences of two runs are noise: that of a pixel and of its copy do not go together."""
    scene, camera, lights = tufted
    twice = np.tile(covered_pixels(scene, camera), 2)
    runs = [render_olat(scene, camera, lights, spp=spp, seed=s, pixels=twice) for s in range(32)]
    noise = np.sqrt(np.stack(runs[::2])) - np.sqrt(np.stack(runs[1::2]))
    one, other = np.split(noise[..., 0], 2, axis=2)
    # 0.02 is its standard deviation over seeds; streams a fixed step apart had up to 0.4
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.08


def test_pixels_of_light_that_is_not_finite_are_rendered_again_or_named(
    tufted, monkeypatch, caplog
):
    scene, camera, lights = tufted
    sound = render_olat(scene, camera, lights, spp=8)
    row, column = np.argwhere(sound.all(axis=(0, 3)))[0]
    pixel, right, times = row * camera.width + column, olat._Plan.render, [0]

    def spoilt(plan, index, spp, seed):
        out = right(plan, index, spp, seed)
        if spp == 8 and times[0]:
            out[1, index == pixel] = np.nan
            times[0] -= 1
        return out

    monkeypatch.setattr(olat._Plan, "render", spoilt)
    times[0] = 1
    again = render_olat(scene, camera, lights, spp=8)
    assert np.argwhere((again != sound).any(axis=(0, 3))).tolist() == [[row, column]]
    assert np.isfinite(again).all()
    assert str(pixel) in caplog.text
    times[0] = 2
    with pytest.raises(FloatingPointError, match=str(pixel)):
        render_olat(scene, camera, lights, spp=8)


def test_a_moved_subject_is_a_moved_stage(small):
    """Turning subject, camera and lights together changes nothing but the noise's seed."""
    angle = 0.7
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )
    shift = np.array([0.01, -0.02, 0.03])
    strands, floor = small.tuft(), small.plane()
    camera, lights = small.camera(), small.lights()
    moved = build_scene(strands.transformed(turn, shift), floor.transformed(turn, shift), hair=HAIR)
    still = build_scene(strands, floor, hair=HAIR)
    a = render_olat(moved, camera, lights, spp=64, max_depth=2).mean((1, 2))
    b = render_olat(
        still,
        camera.moved(turn, shift),
        [x.moved(turn, shift) for x in lights],
        spp=64,
        max_depth=2,
    ).mean((1, 2))
    np.testing.assert_allclose(a, b, rtol=0.02)


def test_only_requested_pixels_are_rendered(tufted):
    scene, camera, lights = tufted
    pixels = np.array([300, 5, 301])
    some = render_olat(scene, camera, lights, spp=8, pixels=pixels)
    assert some.shape == (3, 3, 3)
    assert render_olat(scene, camera, [], spp=8, pixels=pixels).shape == (0, 3, 3)
    pixels = np.arange(6, 24 * 24, 4)
    whole = render_olat(scene, camera, lights, spp=64, max_depth=1).reshape(3, -1, 3)
    part = render_olat(scene, camera, lights, spp=64, max_depth=1, pixels=pixels)
    np.testing.assert_allclose(part.mean(1), whole[:, pixels].mean(1), rtol=0.1)


@pytest.mark.slow
def test_agrees_with_blender_cycles(shared_data, small):
    """Another renderer's capture: mean radiance over the subject, by channel and by light."""
    folder = shared_data("captures/cycles_wavy")
    truth = np.load(folder / "strands_gt.npz")
    params = json.loads((folder / "params.json").read_text())
    strands = Strands(truth["points"], truth["offsets"], float(truth["radius"]))
    hair = HairAppearance(
        tuple(params["sigma_a"]),
        params["beta_m"],
        params["beta_n"],
        params["ior"],
        params["tilt_deg"],
    )
    head = small.ball(tuple(truth["head_axes"]), rows=64)
    scene = build_scene(strands, head, hair=hair, skin=params["head_albedo"])
    lights = [
        Light(str(x["id"]), x["position"], x["intensity"])
        for x in json.loads((folder / "lights.json").read_text())["lights"]
    ]
    ratios = []
    for c in json.loads((folder / "cameras.json").read_text())["cameras"][:3:2]:
        camera = Camera(str(c["id"]), c["width"], c["height"], c["K"], c["R"], c["t"])
        pixels = covered_pixels(scene, camera)[::6]
        ours = render_olat(scene, camera, lights, spp=64, max_depth=48, pixels=pixels)
        theirs = np.array(
            [
                read_exr(folder / f"images/cam_{c['id']:02d}/light_{i:02d}.exr")[0].reshape(-1, 3)[
                    pixels
                ]
                for i in range(len(lights))
            ]
        )
        ratios.append(ours.mean(1) / theirs.mean(1))
    by_channel = np.mean(ratios, axis=(0, 1))
    np.testing.assert_allclose(by_channel, 1, atol=0.03)
    np.testing.assert_allclose(ratios, 1, atol=0.12)
