"""A fitted model for others: maps as EXR, a scene for stock Mitsuba, USD with attributes.

Stock Mitsuba's `hair` has one colour a shape and no correctives: strands are sorted into groups of
like colour, the layers of each averaged. What is lost is the change along strands, correctives and
the differences within a group.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2

from appearance.bsdf.maps import HairMaps
from appearance.model.fitted_model import FittedModel
from appearance.scene.curves import spline_control_points
from appearance.scene.hair_scene import SCALE, mitsuba_hair
from reconstruction import Camera, Mesh, Strands, write_exr, write_obj
from reconstruction.arrays import Array
from reconstruction.files.durable import write_json, write_whole, writing
from reconstruction.files.strands.usd import open_curves, write_usd

SCALARS = ("beta_m", "beta_n", "eta", "tilt_deg")


def export_maps(maps: HairMaps, folder: Path) -> list[Path]:
    """Write an EXR for each layer of absorption and correctives, and `maps.json`.

    `sigma_a_00.exr` is the root's layer; rows are v from the forehead to the nape, columns u.
    Correctives lie in red and green.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, table in (("sigma_a", maps.sigma_a), ("rotation", maps.rotation)):
        for i, layer in enumerate(table):
            image = np.zeros((layer.shape[1], layer.shape[0], 3), np.float32)
            image[..., : layer.shape[2]] = layer.transpose(1, 0, 2)
            written.append(folder / f"{name}_{i:02d}.exr")
            write_exr(written[-1], image)
    about = {"layers": len(maps.sigma_a), "units": "absorption per fibre radius; radians"}
    about |= {k: getattr(maps, k) for k in SCALARS}
    write_json(folder / "maps.json", about)
    return [*written, folder / "maps.json"]


def at_points(maps: HairMaps, strands: Strands, root_uv: Array) -> tuple[Array, Array]:
    """Absorption `(N, 3)` and correctives `(N, 2)` at the strands' points."""
    counts = np.diff(strands.offsets)
    strand = strands.strand_of_point
    along = (np.arange(len(strands.points)) - strands.offsets[:-1][strand]) / (counts[strand] - 1)
    out = []
    for table in (maps.sigma_a, maps.rotation):
        layers, columns, rows, _ = table.shape
        u = np.minimum((root_uv[:, 0] * columns).astype(int), columns - 1)[strand]
        v = np.minimum((root_uv[:, 1] * rows).astype(int), rows - 1)[strand]
        height = along * (layers - 1)
        low = np.minimum(height.astype(int), max(layers - 2, 0))
        share = (height - low)[:, None]
        high = np.minimum(low + 1, layers - 1)
        out.append(table[low, u, v] * (1 - share) + table[high, u, v] * share)
    return out[0], out[1]


def export_usd(model: FittedModel, path: Path) -> None:
    """Write the strands with the maps as primvars, which Blender reads as attributes.

    At each point: `sigma_a`, `rotation`, and `displayColor`, the fibre's colour in dense hair. At
    each strand: `scalp_uv`. Of all: `beta_m`, `beta_n`, `eta`, `tilt_deg`.
    """
    from pxr import Sdf, UsdGeom, Vt

    write_usd(path, model.strands)
    stage, curves = open_curves(path)
    sigma_a, rotation = at_points(model.maps, model.strands, model.root_uv)
    api = UsdGeom.PrimvarsAPI(curves)
    types = Sdf.ValueTypeNames
    tokens = UsdGeom.Tokens
    colour = np.exp(-6.0 * np.sqrt(sigma_a))
    for name, kind, where, values in (
        ("sigma_a", types.Float3Array, tokens.vertex, sigma_a),
        ("rotation", types.Float2Array, tokens.vertex, rotation),
        ("displayColor", types.Color3fArray, tokens.vertex, colour),
        ("scalp_uv", types.TexCoord2fArray, tokens.uniform, model.root_uv),
    ):
        array = Vt.Vec3fArray if values.shape[1] == 3 else Vt.Vec2fArray
        floats = array.FromNumpy(np.ascontiguousarray(values, np.float32))
        api.CreatePrimvar(name, kind, where).Set(floats)
    for name in SCALARS:
        api.CreatePrimvar(name, types.Float, tokens.constant).Set(float(getattr(model.maps, name)))
    stage.GetRootLayer().Save()


def export_mitsuba(
    model: FittedModel, folder: Path, camera: Camera, *, groups: int = 8, spp: int = 64
) -> Path:
    """Write `scene.xml` with its curves and head, for stock Mitsuba; returns its path.

    Units are centimetres, the light an even white sky. `groups` shapes of one colour each.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sigma_a, _ = at_points(model.maps, model.strands, model.root_uv)
    strand = model.strands.strand_of_point
    counts = np.bincount(strand)
    mean = np.stack([np.bincount(strand, s) / counts for s in np.sqrt(sigma_a).T], axis=1)
    k = min(groups, len(np.unique(mean.round(6), axis=0)))
    centres, label = kmeans2(mean, k, seed=0, minit="++") if k > 1 else (mean[:1], counts * 0)
    shapes = []
    for i in range(k):
        of_group = np.flatnonzero(label == i)
        if len(of_group):
            name = f"hair_{i:02d}.txt"
            _write_curves(folder / name, model.strands.subset(of_group))
            shapes.append(_hair(name, centres[i] ** 2, model.maps))
    if model.head is not None:
        scaled = Mesh(model.head.vertices * SCALE, model.head.faces)
        with writing(folder / "head.obj") as part:
            write_obj(part, scaled)
        shapes.append(_head(model.appearance.skin))
    path = folder / "scene.xml"
    text = (
        '<scene version="3.0.0">\n <integrator type="path"><integer name="max_depth" value="16"/>'
        "</integrator>\n"
        + _sensor(camera, spp)
        + "".join(shapes)
        + ' <emitter type="constant"><rgb name="radiance" value="1 1 1"/></emitter>\n</scene>\n'
    )
    write_whole(path, text.encode())
    return path


def _write_curves(path: Path, strands: Strands) -> None:
    points, _ = spline_control_points(strands)
    rows = points * SCALE
    ends = np.cumsum(np.diff(strands.offsets) + 2)
    lines = [" ".join(f"{x:.6g}" for x in row) for row in rows]
    parts = np.split(np.array(lines), ends[:-1])
    text = "\n\n".join("\n".join(part) for part in parts) + "\n"
    write_whole(path, text.encode())


def _hair(file: str, sigma_a: Array, maps: HairMaps) -> str:
    scalars = {k: v for k, v in mitsuba_hair(maps.mean()).items() if isinstance(v, float | int)}
    floats = "".join(f'<float name="{k}" value="{v:.6g}"/>' for k, v in scalars.items())
    rgb = " ".join(f"{x:.6g}" for x in sigma_a)
    return (
        f' <shape type="bsplinecurve"><string name="filename" value="{file}"/>\n'
        f'  <bsdf type="hair">{floats}<rgb name="sigma_a" value="{rgb}"/></bsdf></shape>\n'
    )


def _head(skin: tuple[float, float, float]) -> str:
    rgb = " ".join(f"{x:.6g}" for x in skin)
    return (
        ' <shape type="obj"><string name="filename" value="head.obj"/>\n'
        '  <boolean name="face_normals" value="true"/><bsdf type="twosided"><bsdf type="diffuse">'
        f'<rgb name="reflectance" value="{rgb}"/></bsdf></bsdf></shape>\n'
    )


def _sensor(camera: Camera, spp: int) -> str:
    """A pinhole; the principal point is taken for the middle of the image."""
    fov = np.degrees(2 * np.arctan(0.5 * camera.width / camera.K[0, 0]))
    eye = camera.center * SCALE
    vectors = {"origin": eye, "target": eye + camera.R[2], "up": -camera.R[1]}
    look = " ".join(f'{k}="{", ".join(f"{x:.6f}" for x in value)}"' for k, value in vectors.items())
    return (
        f' <sensor type="perspective"><float name="fov" value="{fov:.6f}"/>\n'
        f'  <string name="fov_axis" value="x"/><transform name="to_world"><lookat {look}/>'
        f'</transform>\n  <sampler type="independent"><integer name="sample_count" value="{spp}"/>'
        f'</sampler>\n  <film type="hdrfilm"><integer name="width" value="{camera.width}"/>'
        f'<integer name="height" value="{camera.height}"/></film></sensor>\n'
    )
