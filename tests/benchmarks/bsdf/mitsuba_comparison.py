"""Our hair BSDF beside Mitsuba's stock `hair`: tables and pictures of docs/explanation/bsdf.md.

Leaves `bsdf.json`, `bsdf.md`, `bsdf_sheet.png` and `bsdf_furnace.png`; a test holds both BSDFs to
what the tables say.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import i0e

from appearance.bsdf import lobes, reference
from appearance.bsdf.bessel import scaled_i0
from appearance.scene.backend import ensure_backend
from benchmarks.bsdf import pictures
from benchmarks.bsdf.integrals import Case, array_types, fibre, sphere, uniforms
from benchmarks.command import Benchmark
from benchmarks.results import markdown, save
from reconstruction import Progress
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array

SAMPLES = 200_000
CASES = [
    Case(0.3, 0.3, 0, 0.3),
    Case(0.3, 0.3, 30, 0.9),
    Case(0.3, 0.3, 30, 1.0),
    Case(0.1, 0.1, 60, 0.5, tilt_deg=2),
    Case(0.03, 0.3, 0, 0.3),
    Case(0.03, 0.3, 85, 0.3),
    Case(0.01, 0.3, 45, 0.3),
    Case(0.01, 0.1, 85, -0.7, tilt_deg=-10),
    Case(0.003, 0.03, 60, 0.5),
    Case(0.001, 0.3, 30, 0.3),
    Case(0.001, 0.001, 89.99, 1.0, 1.0001, tilt_deg=10),
    Case(0.3, 0.001, -89.99, -1.0, 3.0),
    Case(1.0, 1.0, 45, 0.3),
    Case(1.0, 1.0, -89.99, 0.99, 1.0001),
    Case(0.3, 0.3, 30, 0.3, sigma_a=1e4),
]


@dataclass(frozen=True)
class Measured:
    """One BSDF in one case.

    `sampled`: mean weight; `evaluated`: integral of the BSDF times cosine over the sphere;
    `moment`: largest error of the samples' mean direction and mean squared height, in standard
    errors, against the density that the BSDF claims (infinite where it claims none); `in_plane`:
    share of samples exactly in the normal plane; `unusable`: samples of density 0.
    """

    sampled: float
    evaluated: float
    moment: float
    in_plane: float
    unusable: float


def measured(bsdf: Any, case: Case) -> Measured:
    """`bsdf` (a Mitsuba BSDF) at the direction of `case`, in float32."""

    def interaction(lanes: int) -> Any:
        si: Any = dr.zeros(mi.SurfaceInteraction3f, lanes)
        si.wi = mi.Vector3f(*map(float, case.wi))
        return si

    u = uniforms(SAMPLES, 11, False)
    bs, weight = bsdf.sample(mi.BSDFContext(), interaction(SAMPLES), u[0], mi.Point2f(u[1], u[2]))
    drawn = np.array(bs.wo, float).T
    usable = np.array(bs.pdf) > 0
    w, weights = sphere(case)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), interaction(len(w)), mi.Vector3f(for_kernels(w.T)))
    density = np.array(pdf, float) * weights
    moment = float("inf")
    if usable.any():
        moments = np.column_stack([w, w[:, 1] ** 2]).T @ density / density.sum()
        got = np.column_stack([drawn, drawn[:, 1] ** 2])[usable]
        scale = got.std(0) / np.sqrt(len(got)) + 1e-7
        moment = float((np.abs(got.mean(0) - moments) / scale).max())
    return Measured(
        float(np.array(weight[0], float).mean()),
        float(np.array(value[0], float) @ weights),
        moment,
        float(np.mean(np.abs(drawn[:, 1]) < 1e-6)),
        float(np.mean(~usable)),
    )


def compare(case: Case) -> tuple[Measured, Measured]:
    """Ours and the stock plugin in one case, made from the same dictionary."""
    shared = {
        "longitudinal_roughness": case.beta_m,
        "azimuthal_roughness": case.beta_n,
        "int_ior": case.eta,
        "ext_ior": 1.0,
        "scale_tilt": -case.tilt_deg,
        "sigma_a": {"type": "rgb", "value": [case.sigma_a] * 3},
    }
    ours, stock = (mi.load_dict({"type": t, **shared}) for t in ("extended_hair", "hair"))
    return measured(ours, case), measured(stock, case)


def bessel_errors(x: float) -> tuple[float, float]:
    """Relative error of I0(x), ours and stock Mitsuba's, in float32, against SciPy's in float64.

    Mitsuba's is read off its longitudinal lobe where both directions are across the fibre: there
    the lobe is I0(x) exp(-x) x / (2 pi (1 - exp(-2x))).
    """
    single: Any = mi.Float(for_kernels(x))
    exact = float(i0e(x))
    lobe = exact * x / (2 * np.pi * -np.expm1(-2 * x))
    across, along = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    stock = mi.warp.square_to_rough_fiber_pdf(across, across, along, single)
    return float(scaled_i0(single)[0]) / exact - 1, float(stock[0]) / lobe - 1


def reciprocity_error(case: Case, pairs: int = 400, offsets: int = 200) -> float:
    """How far the fibre as a whole is from reciprocal: sum |a - b| / sum (a + b), 0 to 1.

    a is the light that a fibre lit from l sends to v, averaged over its width, times cos(theta_v);
    b the same with v and l exchanged. A reciprocal fibre has a = b. `pairs` directions v, each with
    an l drawn from the BSDF; `case` gives the fibre.
    """
    rng = np.random.default_rng(0)
    theta_v = np.arcsin(rng.uniform(-1, 1, pairs))
    h = (np.arange(offsets) + 0.5) / offsets * 2 - 1
    number, vector = array_types(True)
    first = np.arcsin(rng.uniform(-1, 1, pairs))
    v = vector(reference.direction(theta_v, first).T)
    lit = np.array(
        lobes.sample(fibre(case, True), v, *(number(rng.random(pairs)) for _ in "abc"))[0]
    )
    theta_l, turn = reference.inclination(lit.T), reference.azimuth(lit.T) - first

    def sent(known: Array, other: Array, turn: Any) -> Any:
        gamma = np.arcsin(h)
        wi = reference.direction(known[:, None], gamma).reshape(-1, 3)
        wo = reference.direction(other[:, None], gamma + turn[:, None]).reshape(-1, 3)
        value = lobes.evaluate(fibre(case, True), vector(wi.T), vector(wo.T))[0].x
        return np.array(value).reshape(pairs, offsets).mean(1) * np.cos(known)

    there, back = sent(theta_v, theta_l, turn), sent(theta_l, theta_v, -turn)
    # pairs were drawn in proportion to what they send: each counts once
    return float(np.mean(np.abs(there - back) / (there + back)))


def bessel_table() -> str:
    """Rows of `bessel_errors`."""
    places = (0.1, 1.0, 5.0, 9.99, 10.01, 11.9, 12.1, 20.0, 100.0, 1e4, 1e6)
    rows = [[f"{x:g}", *(f"{error:.1e}" for error in bessel_errors(x))] for x in places]
    return markdown(["x", "ours", "Mitsuba"], rows)


def furnace_table(cases: Sequence[Case] = CASES) -> str:
    """Rows of `compare`: in each pair of columns ours is first."""
    given = ["β_M", "β_N", "θ°", "h", "η", "tilt°", "σ"]
    pairs = ["sampled", "evaluated", "moment, s.e.", "in plane", "density 0"]
    formats = ("{:.4f}", "{:.4f}", "{:.1f}", "{:.2%}", "{:.2%}")
    rows = []
    for c in cases:
        figures = zip(formats, *(astuple(m) for m in compare(c)), strict=True)
        said = [f.format(value) for f, *pair in figures for value in pair]
        rows.append([*_given(c), *said])
    return markdown([*given, *(cell for pair in pairs for cell in (pair, ""))], rows)


def _given(c: Case) -> list[str]:
    """What is given in a row of the furnace table."""
    given = [c.beta_m, c.beta_n, c.theta_deg, c.h, c.eta, c.tilt_deg, c.sigma_a]
    return [f"{g:.6g}" for g in given]


def reciprocity_table(roughness: Sequence[float] = (0.03, 0.1, 0.3, 0.6, 1.0)) -> str:
    """Rows of `reciprocity_error`."""
    rows = []
    for beta in roughness:
        for tilt in (0.0, 3.0):
            cases = [Case(beta, beta, tilt_deg=tilt, sigma_a=s) for s in (0.0, 0.3, 3.0)]
            errors = [f"{reciprocity_error(c):.1%}" for c in cases]
            rows.append([f"{beta:g}", f"{tilt:g}", *errors])
    return markdown(["β_M = β_N", "tilt°", "σ = 0", "σ = 0.3", "σ = 3"], rows)


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    ensure_backend()
    progress("tables", 0.0)
    cases, roughness = (CASES[:1], (0.3,)) if args.quick else (CASES, (0.03, 0.1, 0.3, 0.6, 1.0))
    tables = [bessel_table(), furnace_table(cases), reciprocity_table(roughness)]
    (args.out / "bsdf.md").write_text("\n".join(tables))
    progress("pictures", 0.5)
    effort = {"size": 16, "spp": 4} if args.quick else {}
    furnaces = pictures.furnaces(args.out / "bsdf_furnace.png", **effort)
    pictures.sheet(args.out / "bsdf_sheet.png", **effort)
    rows = [dict(zip(("beta_m", "ours", "mitsuba"), row, strict=True)) for row in furnaces]
    save(args.out / "bsdf.json", {"furnace_means": rows})
    return {"furnace_means": rows}


BENCHMARK = Benchmark(_bench)
