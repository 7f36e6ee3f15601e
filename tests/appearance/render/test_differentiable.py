"""Gradients by path replay against finite differences, and where the two part."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance import DifferentiableOlat, HairAppearance, build_scene, render_olat
from appearance.render.coverage import covered_pixels
from appearance.render.differentiable import ReplaySampling
from appearance.scene.backend import ensure_backend
from appearance.scene.hair_appearance import DiffuseHair
from reconstruction import Camera, Light, Mesh
from reconstruction.geometry.cameras import facing
from reconstruction.geometry.light_profiles import LightProfile

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)
NO_EDGES = ("lights.position", "lights.turn")
"""Parameters that move shadow edges too, or the kinks of a profile."""
STEPS = {"lights.intensity": 0.1, "hair.scale_tilt": 0.05, "lights.position": 2e-3}


def numbers(value):
    return np.array(value, np.float64)


def changed(value, index, step):
    """`value` with one of its numbers changed."""
    array = np.array(value, np.float32)
    array.reshape(-1)[index] += step
    return type(value)(array)


class Objective:
    """A fixed weighting of the picture's pixels, so that no error cancels."""

    def __init__(self, op, seed=0):
        ensure_backend()
        self.op, self.seed = op, seed
        shape = (len(op.lights), len(op.index), 3)
        self.weight = np.random.default_rng(3).uniform(0.5, 1.5, shape) / len(op.index)
        self.tensor = mi.TensorXf(self.weight.astype(np.float32))

    def value(self, **changes):
        picture = self.op.radiance(changes, seed=self.seed)
        return float((numbers(picture) * self.weight).sum())

    def gradient(self, *names):
        parameters = self.op.parameters()
        for name in names:
            dr.enable_grad(parameters[name])
        dr.backward(dr.sum(self.op.radiance(parameters, gradient_seed=self.seed) * self.tensor))
        return {name: numbers(dr.grad(parameters[name])).ravel() for name in names}

    def difference(self, name, index):
        """Central differences along common random numbers, extrapolated to no step."""
        value, step = self.op.parameters()[name], STEPS.get(name, 2e-3)

        def central(step):
            up, down = (self.value(**{name: changed(value, index, s)}) for s in (step, -step))
            return (up - down) / (2 * step)

        return (4 * central(step) - central(2 * step)) / 3


def extended(scene, tables=False):
    """`scene` with our hair BSDF, constant or with volumes of absorption and correctives."""
    from appearance.bsdf.strand_coordinates import strand_parameters

    parameters = {
        "longitudinal_roughness": 0.3,
        "azimuthal_roughness": 0.25,
        "scale_tilt": -2.0,
        "eta": 1.55,
        "sigma_a": mi.TensorXf([[0.1, 0.2, 0.45]]) if tables else [0.1, 0.2, 0.45],
    }
    if tables:
        rng = np.random.default_rng(2)
        shape = mi.traverse(scene.hair_shape)
        segments = np.array(shape["segment_indices"])
        strands = len(segments) // 7
        sigma_a = rng.uniform(0.1, 0.5, (3, 2, 1, 3)).astype(np.float32)
        rotation = rng.normal(scale=0.1, size=(3, 2, 1, 2)).astype(np.float32)
        parameters |= {
            "sigma_a": mi.TensorXf(sigma_a),
            "rotation": mi.TensorXf(rotation),
            **strand_parameters(
                np.array(shape["control_points"]).reshape(-1, 4), segments, np.full(strands, 7)
            ),
        }
    return replace(scene, hair_bsdf=mi.load_dict({"type": "extended_hair", **parameters}))


KINDS = {
    "stock hair": lambda scene: scene.with_hair(HAIR, bsdf="hair"),
    "extended hair": extended,
    "extended hair with volumes": lambda scene: extended(scene, tables=True),
    "diffuse hair": lambda scene: scene.with_hair(DiffuseHair((0.7, 0.5, 0.2))),
}


@pytest.fixture(scope="module")
def tufted(small):
    return build_scene(small.tuft(60), small.plane(), hair=HAIR), small.camera(size=12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_materials_are_differences_of_the_same_paths(tufted, small, kind):
    """All paths up to five vertices, to what float32 leaves of a difference."""
    scene, camera = tufted
    lights = small.lights()[:2]
    guide, lit = KINDS[kind](scene), KINDS[kind](scene)
    op = DifferentiableOlat(
        lit,
        camera,
        lights,
        covered_pixels(scene, camera),
        ReplaySampling(16, 5, 9),
        guide,
    )
    objective = Objective(op)
    names = [k for k in op.parameters() if not k.startswith("lights") and "melanin" not in k]
    found = objective.gradient(*names, "lights.intensity")
    assert {"skin"} < set(names)
    for name, gradient in found.items():
        assert np.isfinite(gradient).all()
        for index in range(min(len(gradient), 3)):
            expected = objective.difference(name, index)
            scale = max(abs(expected), 0.02 * np.abs(gradient).max())
            assert gradient[index] == pytest.approx(expected, abs=1e-3 * scale + 1e-5), name


BEAM = LightProfile(
    "beam",
    np.array([0.0, 90, 180, 270, 360]),
    np.array([0.0, 30, 120]),
    np.array([[1, 0.6, 0], [1, 0.4, 0], [1, 0.3, 0], [1, 0.5, 0], [1, 0.6, 0]]),
)
SHAPES = {
    "point": {},
    "profile": {"orientation": facing((-0.9, 0.5, -0.4), 30.0), "profile": BEAM},
    "sphere": {"radius": 0.04},
    "panel": {"orientation": facing((-0.2, 0.1, -0.9)), "size": (0.2, 0.1)},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_where_nothing_casts_a_shadow_lights_agree_with_differences(small, shape):
    """A convex body and its light, far from the terminator: position, turn and intensity."""
    scene = build_scene(small.no_hair, small.plane(), hair=HAIR, skin=(0.5, 0.4, 0.3))
    camera = small.camera((0.0, -0.3, 0.6), size=8)
    light = Light("l", np.array([0.2, -0.1, 0.4]), np.array([8.0, 4.0, 2.0]), **SHAPES[shape])
    op = DifferentiableOlat(scene, camera, [light], np.arange(64), ReplaySampling(64, 2))
    objective = Objective(op)
    found = objective.gradient("lights.position", "lights.turn", "lights.intensity")
    for name, gradient in found.items():
        if name == "lights.turn" and "orientation" not in SHAPES[shape]:
            assert not gradient.any()
            continue
        for index in range(3):
            expected = objective.difference(name, index)
            assert gradient[index] == pytest.approx(expected, abs=2e-3 * np.abs(gradient).max()), (
                f"{name} {index}"
            )


def test_a_shadow_edge_that_moves_is_left_out(small):
    """A wall's shadow on the floor: the light that the floor gains as the edge recedes is missing.

    The whole of it is known: the edge moves by -(edge height)/(light height - edge height) of what
    the light moves, and the gradient differs from the truth by the radiance at the edge times that.
    """
    height, edge = 1.0, 0.25
    floor = small.plane(0.6).vertices
    wall = np.array([[0, -2, edge], [2, -2, edge], [2, 2, edge], [0, 2, edge]])
    mesh = Mesh(
        np.concatenate([floor, wall]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    )
    scene = build_scene(small.no_hair, mesh, hair=HAIR, skin=(0.5, 0.5, 0.5))
    # looks under the wall, at the place where its edge's shadow falls
    camera = Camera.look_at("c", 24, 24, (-0.1, 0.001, 0.2), (0, 0, 0), 20)
    light = Light("l", np.array([0.0, 0.0, height]), np.full(3, 8.0))
    op = DifferentiableOlat(scene, camera, [light], np.arange(576), ReplaySampling(256, 1))
    objective = Objective(op)
    objective.weight = np.full_like(objective.weight, 1 / 576)
    objective.tensor = type(objective.tensor)(objective.weight.astype(np.float32))
    gradient = objective.gradient("lights.position")["lights.position"]
    step = 0.02
    base = op.parameters()["lights.position"]
    up, down = (objective.value(**{"lights.position": changed(base, 0, s)}) for s in (step, -step))
    difference = (up - down) / (2 * step)
    # at the edge: radiance albedo/pi I/h², three channels; pixels per metre by projection
    at = [camera.project([[s * 1e-3, y, 0] for y in (-1e-3, 1e-3)])[0] for s in (-1, 1)]
    column = [a[:, 0].mean() for a in at]
    row = [a[:, 1].mean() for a in at]
    speed = np.hypot(column[1] - column[0], row[1] - row[0]) / 2e-3  # pixels a metre along x
    length = 24.0  # the shadow's edge crosses the whole image
    missing = -3 * (0.5 / np.pi * 8 / height**2) * speed * length / 576 * edge / (height - edge)
    assert abs(missing) > 5 * abs(gradient[0])
    assert difference - gradient[0] == pytest.approx(missing, rel=0.1)
    assert gradient[2] == pytest.approx(objective.difference("lights.position", 2), rel=0.02)


def test_the_picture_is_that_of_the_olat_renderer(tufted, small):
    scene, camera = tufted
    pixels = covered_pixels(scene, camera)
    lights = small.lights()
    op = DifferentiableOlat(scene, camera, lights, pixels, ReplaySampling(2048, 6))
    ours = numbers(op.radiance({}))
    olat = render_olat(scene, camera, lights, pixels=pixels, thrift=0, spp=2048, max_depth=6)
    assert ours.shape == olat.shape
    np.testing.assert_allclose(ours.mean(1), olat.mean(1), rtol=0.02)


def test_seeds_decide_the_picture_and_the_paths_of_the_gradient(tufted, small):
    scene, camera = tufted
    op = DifferentiableOlat(scene, camera, small.lights(), [66, 67, 78], ReplaySampling(4, 4))
    a, b, c = (numbers(op.radiance({}, seed=s)).tobytes() for s in (1, 1, 2))
    assert a == b != c
    found = [Objective(op, seed=s).gradient("skin")["skin"] for s in (1, 1, 2)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5)
    assert (found[0] != found[2]).any()


def test_a_loss_flows_on_through_other_operations(tufted, small):
    """Parameters of parameters, and a loss that is not linear; nothing else gets a gradient."""
    scene, camera = tufted
    op = DifferentiableOlat(scene, camera, small.lights()[:1], [66, 67, 78], ReplaySampling(16, 3))
    log_sigma = mi.Color3f(np.log([0.1, 0.2, 0.45]))
    dr.enable_grad(log_sigma)
    picture = op.radiance({"hair.sigma_a": dr.exp(log_sigma)}, seed=1, gradient_seed=1)
    dr.backward(dr.sum(dr.square(picture)))
    direct = op.parameters()
    assert not any(dr.grad_enabled(v) for v in direct.values())
    dr.enable_grad(direct["hair.sigma_a"])
    picture = op.radiance(direct, seed=1, gradient_seed=1)
    dr.backward(dr.sum(dr.square(picture)))
    np.testing.assert_allclose(
        numbers(dr.grad(log_sigma)).ravel(),
        numbers(dr.grad(direct["hair.sigma_a"])).ravel() * [0.1, 0.2, 0.45],
        rtol=1e-4,
    )


def test_memory_does_not_grow_with_paths_samples_or_bounces(tufted, small):
    """The gradient is one kernel over pixels, whatever is walked within it."""
    scene, camera = tufted

    def widest(sampling):
        op = DifferentiableOlat(scene, camera, small.lights(), [66, 67, 78], sampling)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            Objective(op).gradient("hair.longitudinal_roughness", "skin")
            history = dr.kernel_history([dr.KernelType.JIT])
        return max(k["size"] for k in history)

    assert widest(ReplaySampling(4, 2)) == widest(ReplaySampling(64, 20))


def test_what_cannot_be_is_refused(tufted, small):
    scene, camera = tufted
    with pytest.raises(ValueError, match="lights must not be empty"):
        DifferentiableOlat(scene, camera, [], [0])
    with pytest.raises(ValueError, match="guide must have a hair BSDF of its own"):
        DifferentiableOlat(scene, camera, small.lights(), [0], guide=scene)
    op = DifferentiableOlat(scene, camera, small.lights(), [0])
    with pytest.raises(ValueError, match=r"unknown parameters \['hair.beta'\]"):
        op.radiance({"hair.beta": 1.0})


@pytest.mark.slow
def test_gradients_are_those_of_the_truth_in_the_mean(tufted, small):
    """Free paths, finite differences of whole renderings: within their standard errors."""
    scene, camera = tufted
    pixels = covered_pixels(scene, camera)
    op = DifferentiableOlat(scene, camera, small.lights(), pixels, ReplaySampling(2048, 4))
    names = ["hair.longitudinal_roughness", "hair.sigma_a", "hair.eta"]
    STEPS.update(dict.fromkeys(names, 0.02))
    runs = [Objective(op, seed=s) for s in range(8)]
    found = [r.gradient(*names) for r in runs]
    for name in names:
        gradient = np.array([f[name][0] for f in found])
        difference = np.array([r.difference(name, 0) for r in runs])
        error = np.sqrt((gradient.var(ddof=1) + difference.var(ddof=1)) / len(runs))
        assert error < 0.2 * abs(gradient.mean())
        assert abs(gradient.mean() - difference.mean()) < 4 * error
