"""USD: strands, head and guides in one frame, with MaterialX's hair on the strands.

    /model                 the default prim, a component
    /model/hair            linear BasisCurves, widths twice the radius
    /model/guides          the guides alone, of purpose "guide", where there are any
    /model/head            the head, its scalp a subset
    /model/materials/…     hair: chiang_hair_bsdf, beside it a preview; skin: a preview

The hair's material is one colour, or textures over the scalp: one for each layer of the maps, mixed
along the strand. Correctives have no place in MaterialX and are left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

from appearance.export.groom import Groom
from appearance.export.maps import SCALARS, layer_image
from reconstruction import write_exr
from reconstruction.arrays import AnyFloats, Ints
from reconstruction.files.strands.usd import define_curves, new_stage, save_stage
from reconstruction.geometry.world_frame import WorldFrame

TYPES = Sdf.ValueTypeNames


def export_usd(
    groom: Groom, path: Path, *, up: Literal["Y", "Z"] = "Z", world: WorldFrame | None = None
) -> list[Path]:
    """Write the groom in metres; returns the files: `path`, and textures beside it.

    With `world`, in the user's frame and unit, which the stage's metadata state, instead of `up`.

    Primvars of a strand: `st`, the root's place on the scalp with v upwards from the nape,
    `strand_id`, `clump`. Of a point: `confidence`; of the material, at a point where it varies:
    `along` (0 root, 1 tip), `sigma_a`, `rotation`, `displayColor`; of all: `beta_m`, `beta_n`,
    `eta`, `tilt_deg`.
    """
    frame = world or WorldFrame(up="z" if up == "Z" else "y")
    stage = new_stage(frame)
    model = UsdGeom.Xform.Define(stage, "/model").GetPrim()
    stage.SetDefaultPrim(model)
    Usd.ModelAPI(model).SetKind(Kind.Tokens.component)
    UsdGeom.Scope.Define(stage, "/model/materials")
    turned = frame.results(groom.strands)
    curves = define_curves(stage, "/model/hair", turned)
    _primvars(groom, UsdGeom.PrimvarsAPI(curves))
    textures = _textures(groom, path)
    _bind(curves, _hair_material(groom, stage, [f"./{t.parent.name}/{t.name}" for t in textures]))
    if len(groom.guides):
        guides = define_curves(stage, "/model/guides", turned.subset(groom.guides))
        guides.CreatePurposeAttr(UsdGeom.Tokens.guide)
        api = UsdGeom.PrimvarsAPI(guides)
        _primvar(api, "strand_id", TYPES.IntArray, UsdGeom.Tokens.uniform, groom.ids[groom.guides])
    if groom.head is not None:
        _head(groom, stage, frame)
    save_stage(stage, path)
    return [path, *textures]


def _primvars(groom: Groom, api: Any) -> None:
    tokens = UsdGeom.Tokens
    _primvar(api, "st", TYPES.TexCoord2fArray, tokens.uniform, groom.st)
    _primvar(api, "strand_id", TYPES.IntArray, tokens.uniform, groom.ids)
    if len(groom.guides):
        _primvar(api, "clump", TYPES.IntArray, tokens.uniform, groom.clump)
    if groom.confidence is not None:
        _primvar(api, "confidence", TYPES.FloatArray, tokens.vertex, groom.confidence)
    maps, where = groom.maps, tokens.vertex
    sigma_a, rotation = np.array([maps.mean().sigma_a]), np.zeros((1, 2))
    if maps.uniform:
        where = tokens.constant
    else:
        sigma_a, rotation = groom.looked_up
        _primvar(api, "along", TYPES.FloatArray, tokens.vertex, groom.along)
    _primvar(api, "sigma_a", TYPES.Float3Array, where, sigma_a)
    _primvar(api, "rotation", TYPES.Float2Array, where, rotation)
    _primvar(api, "displayColor", TYPES.Color3fArray, where, groom.colour(sigma_a))
    for name in SCALARS:
        api.CreatePrimvar(name, TYPES.Float, tokens.constant).Set(float(getattr(maps, name)))


def _primvar(api: Any, name: str, kind: Any, where: Any, values: AnyFloats | Ints) -> None:
    api.CreatePrimvar(name, kind, where).Set(_array(kind, values))


def _array(kind: Any, values: AnyFloats | Ints) -> Any:
    """`values (N,)` or `(N, 2 or 3)` as USD's array of `kind`."""
    if kind == TYPES.IntArray:
        return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32))
    width = 1 if values.ndim == 1 else values.shape[1]
    array = {1: Vt.FloatArray, 2: Vt.Vec2fArray, 3: Vt.Vec3fArray}[width]
    return array.FromNumpy(np.ascontiguousarray(values, np.float32))


def _textures(groom: Groom, path: Path) -> list[Path]:
    """An EXR of absorption for each layer of the maps, in a folder beside `path`."""
    if groom.maps.uniform:
        return []
    folder = path.with_name(f"{path.stem}_textures")
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for i, layer in enumerate(groom.maps.sigma_a):
        files.append(folder / f"sigma_a_{i:02d}.exr")
        write_exr(files[-1], layer_image(layer))
    return files


def _hair_material(groom: Groom, stage: Any, textures: list[str]) -> Any:
    """MaterialX's `chiang_hair_bsdf`, whose conventions are Chiang's and so ours."""
    material = UsdShade.Material.Define(stage, "/model/materials/hair")
    hair = groom.maps.mean()
    roughness = _shader(stage, "hair/roughness", "ND_chiang_hair_roughness")
    roughness.CreateInput("longitudinal", TYPES.Float).Set(hair.beta_m)
    roughness.CreateInput("azimuthal", TYPES.Float).Set(hair.beta_n)
    bsdf = _shader(stage, "hair/bsdf", "ND_chiang_hair_bsdf")
    for lobe in ("R", "TT", "TRT"):
        name = f"roughness_{lobe}"
        bsdf.CreateInput(name, TYPES.Float2).ConnectToSource(
            roughness.CreateOutput(name, TYPES.Float2)
        )
    bsdf.CreateInput("ior", TYPES.Float).Set(hair.eta)
    # [0, 1] is [-90°, 90°]; towards the root is positive there too
    bsdf.CreateInput("cuticle_angle", TYPES.Float).Set(0.5 + hair.tilt_deg / 180)
    absorption = bsdf.CreateInput("absorption_coefficient", TYPES.Float3)
    if textures:
        absorption.ConnectToSource(_layers(stage, textures))
    else:
        absorption.Set(Gf.Vec3f(*hair.sigma_a))
    surface = _shader(stage, "hair/surface", "ND_surface")
    surface.CreateInput("bsdf", TYPES.Token).ConnectToSource(bsdf.CreateOutput("out", TYPES.Token))
    material.CreateSurfaceOutput("mtlx").ConnectToSource(surface.CreateOutput("out", TYPES.Token))
    preview = _preview(stage, "hair/preview", roughness=max(hair.beta_m, 0.3))
    reader = _shader(stage, "hair/colour", "UsdPrimvarReader_float3")
    reader.CreateInput("varname", TYPES.String).Set("displayColor")
    colour = preview.CreateInput("diffuseColor", TYPES.Color3f)
    colour.ConnectToSource(reader.CreateOutput("result", TYPES.Float3))
    material.CreateSurfaceOutput().ConnectToSource(preview.CreateOutput("surface", TYPES.Token))
    return material


def _layers(stage: Any, textures: list[str]) -> Any:
    """The absorption between layers of textures, linear along the strand: an output."""
    st = _shader(stage, "hair/st", "ND_geompropvalue_vector2")
    st.CreateInput("geomprop", TYPES.String).Set("st")
    along = _shader(stage, "hair/along", "ND_geompropvalue_float")
    along.CreateInput("geomprop", TYPES.String).Set("along")
    found = None
    for i, file in enumerate(textures):
        image = _shader(stage, f"hair/layer_{i:02d}", "ND_image_vector3")
        image.CreateInput("file", TYPES.Asset).Set(Sdf.AssetPath(file))
        image.CreateInput("filtertype", TYPES.String).Set("closest")  # cells, as we look them up
        for axis in "uv":  # a place at the map's end is in its last cell, not in the first again
            image.CreateInput(f"{axis}addressmode", TYPES.String).Set("clamp")
        image.CreateInput("texcoord", TYPES.Float2).ConnectToSource(
            st.CreateOutput("out", TYPES.Float2)
        )
        layer = image.CreateOutput("out", TYPES.Float3)
        if found is None:
            found = layer
            continue
        share = _shader(stage, f"hair/share_{i:02d}", "ND_remap_float")
        share.CreateInput("in", TYPES.Float).ConnectToSource(along.CreateOutput("out", TYPES.Float))
        share.CreateInput("inlow", TYPES.Float).Set((i - 1) / (len(textures) - 1))
        share.CreateInput("inhigh", TYPES.Float).Set(i / (len(textures) - 1))
        inside = _shader(stage, f"hair/inside_{i:02d}", "ND_clamp_float")
        inside.CreateInput("in", TYPES.Float).ConnectToSource(
            share.CreateOutput("out", TYPES.Float)
        )
        mix = _shader(stage, f"hair/mix_{i:02d}", "ND_mix_vector3")
        mix.CreateInput("bg", TYPES.Float3).ConnectToSource(found)
        mix.CreateInput("fg", TYPES.Float3).ConnectToSource(layer)
        mix.CreateInput("mix", TYPES.Float).ConnectToSource(inside.CreateOutput("out", TYPES.Float))
        found = mix.CreateOutput("out", TYPES.Float3)
    return found


def _head(groom: Groom, stage: Any, frame: WorldFrame) -> None:
    head = groom.head
    assert head is not None
    mesh = UsdGeom.Mesh.Define(stage, "/model/head")
    points = frame.to_user(head.vertices).astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(head.faces), 3, np.int32)))
    indices = np.ascontiguousarray(head.faces.ravel(), np.int32)
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    corners = [Gf.Vec3f(*map(float, c)) for c in (points.min(axis=0), points.max(axis=0))]
    mesh.CreateExtentAttr(Vt.Vec3fArray(corners))
    api = UsdGeom.PrimvarsAPI(mesh)
    _primvar(
        api, "displayColor", TYPES.Color3fArray, UsdGeom.Tokens.constant, np.array([groom.skin])
    )
    uv = groom.head_st
    if uv is not None:
        _primvar(api, "st", TYPES.TexCoord2fArray, UsdGeom.Tokens.vertex, uv)
    if head.scalp is not None:
        which = Vt.IntArray.FromNumpy(np.flatnonzero(head.scalp).astype(np.int32))
        UsdGeom.Subset.CreateGeomSubset(mesh, "scalp", UsdGeom.Tokens.face, which)
    material = UsdShade.Material.Define(stage, "/model/materials/skin")
    preview = _preview(stage, "skin/preview", roughness=1.0)
    preview.CreateInput("diffuseColor", TYPES.Color3f).Set(Gf.Vec3f(*groom.skin))
    preview.CreateInput("specularColor", TYPES.Color3f).Set(Gf.Vec3f(0))
    preview.CreateInput("useSpecularWorkflow", TYPES.Int).Set(1)
    material.CreateSurfaceOutput().ConnectToSource(preview.CreateOutput("surface", TYPES.Token))
    _bind(mesh, material)


def _preview(stage: Any, name: str, roughness: float) -> Any:
    preview = _shader(stage, name, "UsdPreviewSurface")
    preview.CreateInput("roughness", TYPES.Float).Set(roughness)
    return preview


def _shader(stage: Any, name: str, identifier: str) -> Any:
    shader = UsdShade.Shader.Define(stage, f"/model/materials/{name}")
    shader.CreateIdAttr(identifier)
    return shader


def _bind(what: Any, material: Any) -> None:
    UsdShade.MaterialBindingAPI.Apply(what.GetPrim()).Bind(material)
