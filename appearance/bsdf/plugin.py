"""The Mitsuba plugin `extended_hair`.

Frame: as on Mitsuba's curves, +y of the shading frame runs along the fibre from root to tip and +z
is the normal. Names of stock `hair` have the same meaning.

| parameter | type, default | |
|---|---|---|
| `longitudinal_roughness`, `azimuthal_roughness` | float or `Float (S,)`, 0.3 | in [0.001, 1], d |
| `scale_tilt` | float or `Float (S,)`, 2 | degrees; Mitsuba's sign: + moves R to the tip, d |
| `eta`, or `int_ior` and `ext_ior` | float or a material's name | only the ratio counts, d |
| `sigma_a` | rgb, or `TensorXf` `(S, 3)`, `(n_c, w, h, 3)` | absorption per fibre radius, d |
| `rotation` | `TensorXf` `(S, 2)`, `(n_c, w, h, 2)` | correctives: radians about the strand's |
| | | two transported normals, d |
| `strand_coordinates.NAMES` | arrays | from `strand_parameters`; needed by tables |

S strands; n_c layers from root to tip, linear in between; (w, h) cells of the scalp, of which the
nearest counts. d: differentiable. A table that is the same everywhere costs no lookup.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from appearance.bsdf.lobes import evaluate, known, mean_over_width, sample, value_known
from appearance.bsdf.parameters import HairParameters, StrandHit


def plugin() -> Any:
    """The plugin's class for the current variant; its base is another one in each."""

    class ExtendedHair(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            kind = mi.BSDFFlags.Glossy | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.NonSymmetric
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [kind | sides]
            self.m_flags = kind | sides
            self.parameters = HairParameters(props)

        def traverse(self, callback: Any) -> None:
            for name, value in self.parameters.values.items():
                callback.put(name, value, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            self.parameters.refresh()

        def sample(
            self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
        ) -> tuple[Any, Any]:
            fibre, frame = self._at(si, active)
            wi = frame.enter(si.wi)
            wo, pdf, weight = sample(fibre, wi, sample1, sample2.x, sample2.y)
            bs: Any = mi.BSDFSample3f()
            bs.wo = frame.leave(wo)
            bs.pdf = dr.select(active, pdf, 0)
            bs.eta = 1
            bs.sampled_type = +mi.BSDFFlags.Glossy
            bs.sampled_component = 0
            return bs, dr.select(active, mi.Color3f(weight), 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            fibre, frame = self._at(si, active)
            value, pdf = evaluate(fibre, frame.enter(si.wi), frame.enter(wo))
            return dr.select(active, mi.Color3f(value), 0), dr.select(active, pdf, 0)

        def towards(self, si: Any, active: Any, mean_width: bool) -> Callable[[Any, Any], Any]:
            """`eval` of `si` towards `(wo, active)`; what does not depend on `wo` is computed once.

            With `mean_width` averaged over parts of the width (`mean_over_width`).
            """
            fibre, frame = self._at(si, active)
            wi = frame.enter(si.wi)
            if mean_width:
                mean = mean_over_width(fibre, wi)
                return lambda wo, active: mi.Color3f(mean(frame.enter(wo)))
            k = known(fibre, wi)
            return lambda wo, active: mi.Color3f(value_known(k, frame.enter(wo)))

        def to_string(self) -> str:
            return f"extended_hair[{', '.join(self.parameters.values)}]"

        def _at(self, si: Any, active: Any) -> tuple[Any, Any]:
            place = StrandHit(self.parameters.strands, si, active)
            return self.parameters.fibre(place), self.parameters.frame(place)

    return ExtendedHair
