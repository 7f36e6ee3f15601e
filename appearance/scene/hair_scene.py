"""The Mitsuba scene of strands on a head, and the materials on it.

The scene is in centimetres: Mitsuba offsets secondary rays by more than a fibre's radius when its
unit is a metre (10 to 12 % too dark, measured). Radiance has no length in it, so a light of
intensity I in W/sr becomes one of I · SCALE² and everything that a renderer returns is in
W/(sr m²) without further ado.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.scene.backend import ensure_backend
from appearance.scene.hair_appearance import DiffuseHair, HairAppearance
from reconstruction import Camera, Mesh, Strands
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.geometry.splines import spline_control_points

SCALE = 100.0
"""Scene units per metre."""
SHINE_EXPONENT = 60.0
"""Of the specular lobe of `FaceMaterials`: polished plastic or metal."""


class SceneField(Protocol):
    """A field of reflectance on hair; what it gives is a `render.pixel_field.PixelField`."""

    def at_pixels(self, scene: HairScene, camera: Camera, pixels: Ints) -> Any:
        """The field at the flat `pixels (P,)` of `camera`."""


@dataclass(frozen=True, eq=False)
class FaceMaterials:
    """Diffuse `albedo (F, 3)` and specular reflectance `shine (F,)` of the F faces of a head.

    The specular lobe is Blinn-Phong's of exponent `SHINE_EXPONENT`, normalised.
    """

    albedo: Array
    shine: Array


@dataclass(frozen=True, eq=False)
class HairScene:
    """Geometry with its acceleration structure, and materials.

    `mi_scene` is a `mitsuba.Scene` without emitters or sensors, in centimetres. `hair_bsdf` is a
    `mitsuba.BSDF`, or None for `DiffuseHair`. `with_hair` and `with_skin` share the geometry.
    `materials` of the head's faces replace `skin`. `field` is a reflectance field, used by
    `render_olat`, `render_environment`, `render_mixed` and the smoothed images, not by gradients
    and scanlines.
    """

    mi_scene: Any
    hair_shape: Any | None
    head_shape: Any | None
    hair: HairAppearance | DiffuseHair
    skin: tuple[float, float, float]
    hair_bsdf: Any | None
    field: SceneField | None = None
    materials: FaceMaterials | None = None

    def occluded(self, ray: Any, active: Any = True) -> Any:
        """Whether `ray` meets anything before its end.

        OptiX implements Mitsuba's `ray_test` by a coarser intersector (NVIDIA's forum, topic
        269395), by which a ray through the fibre it starts on may hit that fibre's far side: hair
        lit from behind is 15 to 18 % too dark. On a GPU the nearest hit is computed instead.
        """
        if str(mi.variant()).startswith("cuda"):
            return self.mi_scene.ray_intersect_preliminary(ray, False, active).is_valid()
        return self.mi_scene.ray_test(ray, active)

    def with_hair(
        self, hair: HairAppearance | DiffuseHair, *, bsdf: str = "extended_hair"
    ) -> HairScene:
        """The same geometry with another hair material and no field; nothing is rebuilt.

        `bsdf` is the plugin of a `HairAppearance`: ours, or Mitsuba's `"hair"` for comparisons.
        """
        return replace(self, hair=hair, hair_bsdf=_hair_bsdf(hair, bsdf), field=None)

    def with_skin(self, skin: ArrayLike) -> HairScene:
        """The same geometry with another diffuse albedo `skin (3,)` on the head."""
        return replace(self, skin=_albedo(skin))


def build_scene(
    strands: Strands,
    head: Mesh | None,
    *,
    hair: HairAppearance | DiffuseHair,
    skin: ArrayLike = (0.35, 0.25, 0.2),
    materials: FaceMaterials | None = None,
) -> HairScene:
    """Build the scene of `strands` on `head`; either may be empty or absent.

    Strands become round cubic curves through their points (`reconstruction.geometry.splines`); the
    head is a two-sided Lambertian surface of albedo `skin (3,)` in [0, 1] with flat faces, or of
    `materials` per face. Raises `ValueError` for albedos out of range.
    """
    ensure_backend()
    albedo = _albedo(skin)
    parts: dict[str, Any] = {"type": "scene"}
    hair_shape = _curves(strands) if len(strands) else None
    head_shape = _mesh(head) if head is not None and len(head.faces) else None
    if hair_shape is not None:
        parts["hair"] = hair_shape
    if head_shape is not None:
        parts["head"] = head_shape
    scene = mi.load_dict(parts)
    bsdf = _hair_bsdf(hair)
    return HairScene(scene, hair_shape, head_shape, hair, albedo, bsdf, materials=materials)


def mitsuba_hair(hair: HairAppearance, bsdf: str = "extended_hair") -> dict[str, Any]:
    """The plugin `extended_hair` or Mitsuba's `hair`: the one place that knows their conventions.

    Mitsuba's curves run along +y of the shading frame, from root to tip, and a positive
    `scale_tilt` moves R towards the tip: the opposite of ours and of Blender's.
    """
    return {
        "type": bsdf,
        "longitudinal_roughness": hair.beta_m,
        "azimuthal_roughness": hair.beta_n,
        "scale_tilt": -hair.tilt_deg,
        "int_ior": hair.eta,
        "ext_ior": 1.0,
        "sigma_a": {"type": "rgb", "value": list(hair.sigma_a)},
    }


def _hair_bsdf(hair: HairAppearance | DiffuseHair, bsdf: str = "extended_hair") -> Any | None:
    if isinstance(hair, DiffuseHair):
        return None
    return mi.load_dict(mitsuba_hair(hair, bsdf))


def _albedo(skin: ArrayLike) -> tuple[float, float, float]:
    values = np.asarray(skin, float)
    if values.shape != (3,) or not ((values >= 0) & (values <= 1)).all():
        raise ValueError(f"skin must be an albedo of 3 numbers in [0, 1], got {values}")
    return float(values[0]), float(values[1]), float(values[2])


def _curves(strands: Strands) -> Any:
    """A `bsplinecurve` of `strands`.

    The plugin reads its curves from a text file only: it gets one short curve, and the real
    arrays replace that one through its parameters.
    """
    points, segments = _guarded(*spline_control_points(strands))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "curve.txt"
        file.write_text("0 0 0 1\n0 0 1 1\n0 0 2 1\n0 0 3 1\n")
        shape = mi.load_dict({"type": "bsplinecurve", "filename": str(file)})
    parameters = mi.traverse(shape)
    parameters["control_point_count"] = len(points)
    parameters["segment_indices"] = mi.UInt32(for_kernels(segments, np.uint32))
    parameters["control_points"] = mi.Float(for_kernels((points * SCALE).ravel()))
    parameters.update()
    return shape


def _guarded(points: Array, segments: Ints) -> tuple[Array, Ints]:
    """The curves and copies of their last segment, thin inside it, where no ray meets them.

    Mitsuba derives a hit's segment from one float32 coordinate over all segments. Rounding takes a
    hit near the end of the last one past the end of its array (a read out of bounds at a million
    segments); with copies it is the copy, which has the same axis.
    """
    copies = 1 + int(np.ceil(len(segments) * np.finfo(np.float32).eps))
    last = points[segments[-1] : segments[-1] + 4] * (1, 1, 1, 1e-3)
    return (
        np.concatenate([points, last]),
        np.concatenate([segments, np.full(copies, len(points))]),
    )


def _mesh(head: Mesh) -> Any:
    mesh = mi.Mesh("head", len(head.vertices), len(head.faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(for_kernels((head.vertices * SCALE).ravel()))
    parameters["faces"] = mi.UInt32(for_kernels(head.faces.ravel(), np.uint32))
    parameters.update()
    return mesh


def light_arrays(lights: Sequence[Any]) -> tuple[Floats, Floats]:
    """Positions and intensities `(L, 3)` of `lights` in the scene's units."""
    position = np.array([light.position for light in lights], float).reshape(-1, 3) * SCALE
    intensity = np.array([light.intensity for light in lights], float).reshape(-1, 3) * SCALE**2
    return position.astype(np.float32), intensity.astype(np.float32)
