"""The plugin `extended_hair` in Mitsuba: parameters, tables over strands, correctives, renders."""

import math
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from benchmarks.bsdf.integrals import Case
from scipy.spatial.transform import Rotation

from appearance import HairAppearance, build_scene
from appearance.bsdf import reference
from appearance.bsdf.lobes import Fibre
from appearance.bsdf.parameters import StrandHit
from appearance.bsdf.strand_coordinates import strand_parameters
from appearance.scene.hair_scene import SCALE
from reconstruction import Strands
from reconstruction.geometry.splines import spline_control_points

HAIR = HairAppearance((0.2, 0.4, 0.8), 0.3, 0.3)


@pytest.fixture(scope="module")
def tuft():
    """60 curved strands of 10 points: the scene, the curves' parameters, and hits with truth."""
    rng = np.random.default_rng(4)
    t = np.linspace(0, 1, 10)[:, None]
    root = np.column_stack([rng.uniform(-0.02, 0.02, (60, 2)), np.zeros(60)])
    bend = rng.normal(scale=0.006, size=(60, 1, 3)) * t**2
    points = root[:, None] + bend + 0.05 * t * np.array([0.0, 0, 1])
    strands = Strands(points.reshape(-1, 3).astype(np.float32), 10 * np.arange(61), radius=4e-4)
    scene = build_scene(strands, None, hair=HAIR)
    shape = mi.traverse(scene.hair_shape)
    curves = strand_parameters(
        np.array(shape["control_points"]).reshape(-1, 4),
        np.array(shape["segment_indices"]),
        np.full(60, 9),
        root_uv=(root[:, :2] + 0.02) / 0.04,
    )
    n = 20_000
    origin = rng.uniform(-2, 2, (n, 3)) + np.array([0, 0, 2.5])
    direction = mi.Vector3f(rng.normal(size=(n, 3)).T.astype(np.float32))
    ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), dr.normalize(direction))
    return scene, curves, scene.mi_scene.ray_intersect(ray), strands


def hair(**parameters):
    return mi.load_dict({"type": "extended_hair", **parameters})


def interaction(case: Case, lanes: int = 1):
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.wi = mi.Vector3f(*map(float, case.wi))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    return si


def evaluate(bsdf, si, wo):
    return np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo.T.astype(np.float32))), float)


def test_importing_the_package_registers_the_plugin_before_and_after_a_variant():
    code = (
        "import sys, appearance.scene.backend as b; {first}import appearance; {then}"
        "import mitsuba as mi; print(mi.load_dict({{'type': 'extended_hair'}}).class_name())"
    )
    for first, then in (("b.ensure_backend(); ", ""), ("", "b.ensure_backend(); ")):
        command = [sys.executable, "-c", code.format(first=first, then=then)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr


def test_parameters_mean_what_they_mean_in_the_lobes():
    case = Case(0.2, 0.4, 30, 0.4, 1.6, 3.0, 0.5)
    bsdf = hair(
        longitudinal_roughness=0.2,
        azimuthal_roughness=0.4,
        int_ior=1.6,
        ext_ior=1.0,
        scale_tilt=-3.0,
        sigma_a={"type": "rgb", "value": [1.0, 0.5, 0.0]},
    )
    wo = reference.direction(np.linspace(-1.4, 1.4, 50), np.linspace(-3, 3, 50))
    si = interaction(case, 50)
    got = evaluate(bsdf, si, wo)
    for channel, sigma in enumerate((1.0, 0.5, 0.0)):
        want = reference.evaluate(Fibre(sigma, **case.optics), case.wi, wo)
        assert got[channel] == pytest.approx(want, rel=1e-4, abs=1e-6)
    u = mi.PCG32(50)
    bs, weight = bsdf.sample(
        mi.BSDFContext(), si, u.next_float32(), mi.Point2f(u.next_float32(), u.next_float32())
    )
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo)
    assert np.array(pdf) == pytest.approx(np.array(bs.pdf), rel=1e-5)
    assert np.array(weight) == pytest.approx(np.array(value / pdf), rel=1e-5)


def test_the_stock_plugin_agrees_where_it_is_sound():
    """With a dark fibre, whose residual lobe carries nothing, at medium roughness."""
    shared = {
        "longitudinal_roughness": 0.3,
        "azimuthal_roughness": 0.35,
        "scale_tilt": 2.5,
        "int_ior": 1.55,
        "ext_ior": 1.0,
        "sigma_a": {"type": "rgb", "value": [0.8, 1.5, 4.0]},
    }
    stock = mi.load_dict({"type": "hair", **shared})
    wo = reference.direction(np.linspace(-1.2, 1.2, 200), np.linspace(-3, 3, 200))
    for case in (Case(theta_deg=20, h=0.5), Case(theta_deg=-50, h=-0.3), Case(h=0.9)):
        si = interaction(case, 200)
        got, want = evaluate(hair(**shared), si, wo), evaluate(stock, si, wo)
        # its I0 alone is off by up to 0.6 %
        assert got == pytest.approx(want, rel=0.015, abs=1e-4)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"longitudinal_roughness": 0.0}, r"longitudinal_roughness must be .* \[0.001, 1\]"),
        ({"azimuthal_roughness": 1.5}, "azimuthal_roughness must be"),
        ({"eta": 1.0}, "eta must be"),
        ({"int_ior": 1.0, "ext_ior": 1.5}, "int_ior/ext_ior must be"),
        ({"eta": 1.5, "int_ior": 1.5}, "not both"),
        ({"scale_tilt": 30.0}, "scale_tilt must be"),
        ({"sigma_a": -1.0}, "sigma_a must be"),
        ({"sigma_a": ("tensor", (4, 2))}, r"sigma_a must be a tensor .* got \(4, 2\)"),
        ({"sigma_a": ("tensor", (2, 3, 3, 3))}, "merge strand_parameters"),
        ({"rotation": ("tensor", (2, 3, 3, 3))}, "rotation must be a tensor"),
        ({"rotation": ("tensor", (1, 1, 1, 2))}, "merge strand_parameters"),
    ],
)
def test_a_parameter_that_does_not_fit_is_refused_by_name(parameters, message):
    given = {
        k: mi.TensorXf(np.ones(v[1], np.float32)) if isinstance(v, tuple) else v
        for k, v in parameters.items()
    }
    with pytest.raises(RuntimeError, match=message):
        hair(**given)


def true_place(strands, si):
    """Strand and on-strand coordinate of the hits, from the nearest point of the dense spline."""
    control, segments = spline_control_points(strands)
    v = np.linspace(0, 1, 201)[:, None]
    basis = np.hstack(
        [(1 - v) ** 3, 3 * v**3 - 6 * v**2 + 4, -3 * v**3 + 3 * v**2 + 3 * v + 1, v**3]
    )
    segment = np.minimum(np.array(si.prim_index), len(segments) - 1)
    curve = np.einsum("vk,nkc->nvc", basis / 6, control[segments[segment][:, None] + np.arange(4)])
    p = np.array(si.p).T / SCALE
    nearest = np.linalg.norm(curve[..., :3] - p[:, None], axis=-1).argmin(-1)
    return segment // 9, (segment % 9 + v[nearest, 0]) / 9


def test_a_volume_is_looked_up_by_strand_and_place_on_it(tuft):
    _, curves, si, strands = tuft
    rng = np.random.default_rng(0)
    volume = rng.uniform(0.1, 2, (5, 4, 3, 3)).astype(np.float32)
    bsdf = hair(sigma_a=mi.TensorXf(volume), **curves)
    hit = np.flatnonzero(np.array(si.is_valid()))
    assert len(hit) > 300
    place = StrandHit(bsdf.parameters.strands, si, si.is_valid())
    got = np.array(bsdf.parameters.fibre(place).sigma_a)[:, hit].T
    strand, along = (a[hit] for a in true_place(strands, si))
    assert (np.array(place.strand)[hit] == strand).all()
    assert np.array(place.along)[hit] == pytest.approx(along, abs=0.002)
    uv = np.array(curves["root_uv"]).reshape(-1, 2)[strand]
    column, row = np.minimum(uv * (4, 3), (3, 2)).astype(int).T
    below = np.minimum((along * 4).astype(int), 3)
    part = (along * 4 - below)[:, None]
    want = (1 - part) * volume[below, column, row] + part * volume[below + 1, column, row]
    assert got == pytest.approx(want, abs=0.02)


@pytest.mark.slow
def test_lookups_are_exact_among_millions_of_segments():
    """4 million segments: a float32 has no room for one coordinate over all of them."""
    strands, each = 40_000, 100
    x = np.arange(each + 3) - 1.0
    points = np.zeros((strands, each + 3, 4))
    points[..., 0] = x
    points[..., 1] = np.arange(strands)[:, None]
    first = (np.arange(strands)[:, None] * (each + 3) + np.arange(each)).ravel()
    curves = strand_parameters(points, first, np.full(strands, each))
    rng = np.random.default_rng(0)
    strand, segment = rng.integers(0, strands, 5000), rng.integers(0, each, 5000)
    strand[:2], segment[:2] = strands - 1, (0, each - 1)
    inside = rng.uniform(0, 1, 5000)
    si = dr.zeros(mi.SurfaceInteraction3f, 5000)
    si.prim_index = mi.UInt32((strand * each + segment).astype(np.uint32))
    si.p = mi.Point3f(np.stack([segment + inside, strand, np.full(5000, 0.01)]).astype(np.float32))
    table = rng.uniform(0, 3, (strands, 3)).astype(np.float32)
    bsdf = hair(sigma_a=mi.TensorXf(table), **curves)
    place = StrandHit(bsdf.parameters.strands, si, mi.Bool(True))
    got = np.array(bsdf.parameters.fibre(place).sigma_a).T
    assert (got == table[strand]).all()
    assert np.array(place.along) == pytest.approx((segment + inside) / each, abs=1e-6)
    # strands run along x: a frame whose y is off by 10 degrees, as Mitsuba's may be, is put right
    for off in (0.0, 0.17):
        s, c = math.sin(off), math.cos(off)
        si.sh_frame = mi.Frame3f(
            mi.Vector3f(-s, -c, 0), mi.Vector3f(c, -s, 0), mi.Vector3f(0, 0, 1)
        )
        frame = bsdf.parameters.frame(StrandHit(bsdf.parameters.strands, si, mi.Bool(True)))
        world = mi.Vector3f(0.36, 0.48, 0.8)
        assert np.array(frame.enter(si.to_local(world)))[:, 0] == pytest.approx([-0.48, 0.36, 0.8])
        assert np.array(frame.leave(frame.enter(world)))[:, 0] == pytest.approx([0.36, 0.48, 0.8])


def test_every_parameter_may_be_one_per_strand(tuft):
    _, curves, si, _ = tuft
    rng = np.random.default_rng(1)
    per_strand = {
        "longitudinal_roughness": rng.uniform(0.1, 0.9, 60),
        "azimuthal_roughness": rng.uniform(0.1, 0.9, 60),
        "eta": rng.uniform(1.3, 1.7, 60),
        "scale_tilt": rng.uniform(-4, 4, 60),
    }
    bsdf = hair(**{k: mi.Float(v.astype(np.float32)) for k, v in per_strand.items()}, **curves)
    wo = np.array([[0.48, 0.6, 0.64]])
    got = evaluate(bsdf, si, wo)
    strand = np.array(si.prim_index) // 9
    for s in (3, 30):
        alone = hair(**{k: float(v[s]) for k, v in per_strand.items()})
        on_it = np.array(si.is_valid()) & (strand == s)
        assert on_it.any()
        want = evaluate(alone, si, wo)
        assert got[:, on_it] == pytest.approx(want[:, on_it], rel=1e-4, abs=1e-6)


def test_a_corrective_turns_the_shading_frame_about_the_strands_own_normals(tuft):
    """As if the strand ran along the turned direction: wi, wo seen from the turned frame."""
    _, curves, si, _ = tuft
    turn = np.zeros((1, 1, 1, 2), np.float32)
    turn[...] = 0.1, -0.05
    plain = hair(sigma_a=0.3)
    turned = hair(sigma_a=0.3, rotation=mi.TensorXf(turn), **curves)
    hit = si.is_valid()
    hits = np.flatnonzero(np.array(hit))
    frame = [np.array(v).T[hits] for v in (si.sh_frame.s, si.sh_frame.t, si.sh_frame.n)]
    tangent = frame[1]
    first = np.array(curves["reference_normals"]).reshape(-1, 3)[np.array(si.prim_index)[hits]]
    first = first - (first * tangent).sum(-1, keepdims=True) * tangent
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    rotation = Rotation.from_rotvec(0.1 * first - 0.05 * np.cross(tangent, first))
    rotated = np.stack([rotation.apply(f) for f in frame], 1)
    wo = np.array([0.36, 0.48, 0.8])
    local = np.stack(frame, 1).swapaxes(1, 2) @ wo
    world_wi = np.einsum("nkc,nk->nc", np.stack(frame, 1), np.array(si.wi).T[hits])
    new = dr.zeros(mi.SurfaceInteraction3f, len(hits))
    new.wi = mi.Vector3f(np.einsum("nkc,nc->nk", rotated, world_wi).T.astype(np.float32))
    want = evaluate(plain, new, np.einsum("nkc,nc->nk", rotated, local))
    got = np.array(turned.eval(mi.BSDFContext(), si, mi.Vector3f(*wo.tolist()), hit))[:, hits]
    assert got == pytest.approx(want, rel=2e-3, abs=1e-4)
    u = mi.PCG32(dr.width(si))
    bs, weight = turned.sample(
        mi.BSDFContext(), si, u.next_float32(), mi.Point2f(u.next_float32(), u.next_float32())
    )
    value, pdf = turned.eval_pdf(mi.BSDFContext(), si, bs.wo, si.is_valid())
    assert np.array(pdf)[hits] == pytest.approx(np.array(bs.pdf)[hits], rel=0.01)
    assert np.array(value / pdf)[:, hits] == pytest.approx(np.array(weight)[:, hits], rel=0.01)


def test_gradients_of_volume_and_correctives_match_differences(tuft):
    _, curves, si, _ = tuft
    rng = np.random.default_rng(5)
    start = {
        "sigma_a": rng.uniform(0.2, 1, (3, 2, 2, 3)).astype(np.float32),
        "rotation": rng.normal(scale=0.05, size=(3, 2, 2, 2)).astype(np.float32),
    }
    hits = si.is_valid()

    def total(bsdf):
        value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0.36, 0.48, 0.8), hits)
        return dr.mean(value.x + 2 * value.y + 3 * value.z) * 100

    bsdf = hair(**{k: mi.TensorXf(v) for k, v in start.items()}, **curves)
    parameters = mi.traverse(bsdf)
    for name, values in start.items():
        parameters[name] = mi.TensorXf(values)
        dr.enable_grad(parameters[name])
        parameters.update()
        dr.backward(total(bsdf))
        got = np.array(dr.grad(parameters[name]))
        cell = tuple(np.unravel_index(np.abs(got).argmax(), got.shape))
        ends = []
        for step in (-0.02, 0.02):
            moved = values.copy()
            moved[cell] += step
            parameters[name] = mi.TensorXf(moved)
            parameters.update()
            ends.append(float(total(bsdf)[0]))
        parameters[name] = mi.TensorXf(values)
        parameters.update()
        assert got[cell] == pytest.approx((ends[1] - ends[0]) / 0.04, rel=0.01)


def lit_scene(shape):
    return mi.load_dict(
        {
            "type": "scene",
            "hair": shape,
            "light": {"type": "point", "position": [0, -30, 20], "intensity": 500.0},
            "sensor": {
                "type": "perspective",
                "fov": 14,
                "to_world": mi.ScalarTransform4f().look_at([5, -20, 2], [0, 0, 2.5], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16},
            },
        }
    )


def test_path_replay_reaches_every_parameter(tuft):
    scene, curves, _, _ = tuft
    given = {
        "sigma_a": mi.TensorXf(np.full((2, 2, 2, 3), 0.3, np.float32)),
        "rotation": mi.TensorXf(np.full((2, 2, 2, 2), 0.02, np.float32)),
    }
    bsdf = hair(**given, **curves)
    scene.hair_shape.set_bsdf(bsdf)
    parameters = mi.traverse(bsdf)
    for key in list(parameters.keys()):
        dr.enable_grad(parameters[key])
    integrator = mi.load_dict({"type": "prb", "max_depth": 4})
    image = mi.render(lit_scene(scene.hair_shape), parameters, integrator=integrator, spp=16)
    assert np.isfinite(np.array(image)).all()
    dr.backward(dr.mean(image))
    for key in list(parameters.keys()):
        gradient = np.array(dr.grad(parameters[key]))
        assert np.isfinite(gradient).all(), key
        assert np.abs(gradient).max() > 0, key
