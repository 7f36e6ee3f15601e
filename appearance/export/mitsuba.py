"""A scene for stock Mitsuba 3.

Its `hair` has one colour a shape: segments are grouped into shapes of similar colour, which keep
their control points. Differences within a shape and correctives are lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2

from appearance.bsdf.maps import HairMaps
from appearance.export.groom import Groom
from appearance.scene.hair_scene import SCALE, mitsuba_hair
from reconstruction import Camera, Mesh, write_exr, write_obj
from reconstruction.arrays import AnyFloats, Array, Ints
from reconstruction.files.durable import write_whole, writing
from reconstruction.geometry.splines import spline_control_points

GROUPS = 32
"""Shapes of one colour each."""
SAMPLE = 20000
"""Segments from whose colours those of the shapes are found."""


@dataclass(frozen=True, eq=False)
class View:
    """A `camera` and an `environment (h, w, 3)` in our renderers' convention."""

    camera: Camera
    environment: AnyFloats
    spp: int = 64


def export_mitsuba(groom: Groom, folder: Path, view: View) -> list[Path]:
    """Write `scene.xml`, its curves, the head and the environment; returns them, the scene first.

    Units are centimetres; radiance is ours. A pinhole of square pixels: see `off_by`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written, shapes = [folder / "scene.xml"], []
    points, segments = spline_control_points(groom.strands)
    colours, label = _shapes(groom)
    for i, colour in enumerate(colours):
        of_shape = segments[label == i]
        if len(of_shape):
            written.append(folder / f"hair_{i:02d}.txt")
            _write_curves(written[-1], points, of_shape)
            shapes.append(_hair(written[-1].name, colour, groom.maps))
    if groom.head is not None:
        scaled = Mesh(groom.head.vertices * SCALE, groom.head.faces)
        written.append(folder / "head.obj")
        with writing(written[-1]) as part:
            write_obj(part, scaled)
        shapes.append(_head(groom.skin))
    written.append(folder / "environment.exr")
    write_exr(written[-1], np.asarray(view.environment, np.float32))
    text = (
        '<scene version="3.0.0">\n <integrator type="path"><integer name="max_depth" value="16"/>'
        '<boolean name="hide_emitters" value="true"/></integrator>\n'
        + _sensor(view.camera, view.spp)
        + "".join(shapes)
        # ours has z up and +x in the middle of the map; Mitsuba's local frame is y up
        + ' <emitter type="envmap"><string name="filename" value="environment.exr"/>\n'
        '  <transform name="to_world"><matrix value="0 0 1 0 1 0 0 0 0 1 0 0 0 0 0 1"/>'
        "</transform></emitter>\n</scene>\n"
    )
    write_whole(written[0], text.encode())
    return written


def off_by(camera: Camera) -> float:
    """Pixels that a scene's image is off from one by `camera`, at most.

    Stock Mitsuba has no lens, no skew, and one focal length: the horizontal one.
    """
    x, y = (np.linspace(0, n - 1, 17) for n in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    f, K = camera.K[0, 0], camera.K
    square = replace(camera.pinhole(), K=np.array([[f, 0, K[0, 2]], [0, f, K[1, 2]], [0, 0, 1]]))
    seen, _ = square.project(camera.center + camera.rays(pixels))
    return float(np.linalg.norm(seen - pixels, axis=-1).max())


def _shapes(groom: Groom) -> tuple[Array, Ints]:
    """Absorptions `(G, 3)` of the shapes, and the shape of each segment `(N - S,)`."""
    starts = groom.strands.segment_starts
    if groom.maps.uniform or not len(starts):
        return np.array([groom.maps.mean().sigma_a]), np.zeros(len(starts), np.int64)
    sigma_a, _ = groom.looked_up
    root = np.sqrt(0.5 * (sigma_a[starts] + sigma_a[starts + 1]))  # colours are even in the root
    few = np.random.default_rng(0).choice(len(root), min(SAMPLE, len(root)), replace=False)
    different = np.unique(root[few].round(6), axis=0)
    k = min(GROUPS, len(different))
    if k == len(different):
        centres = different
    else:
        centres, _ = kmeans2(root[few], k, seed=0, minit="++")
    label = np.empty(len(root), np.int64)
    for part in np.array_split(np.arange(len(root)), max(len(root) // 200_000, 1)):
        label[part] = ((root[part, None] - centres) ** 2).sum(axis=2).argmin(axis=1)
    means = [
        root[label == i].mean(axis=0) if (label == i).any() else c for i, c in enumerate(centres)
    ]
    return np.stack(means) ** 2, label


def _write_curves(path: Path, points: Array, segments: Ints) -> None:
    """Control points `(M, 4)` of runs of `segments`, whose first points these are, as text."""
    ends = np.flatnonzero(np.diff(segments) != 1)
    runs = np.split(segments, ends + 1)
    text = []
    for run in runs:
        rows = points[run[0] : run[-1] + 4] * SCALE
        text.append("\n".join(f"{x:.7g} {y:.7g} {z:.7g} {r:.6g}" for x, y, z, r in rows.tolist()))
    write_whole(path, ("\n\n".join(text) + "\n").encode())


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
    fov = np.degrees(2 * np.arctan(0.5 * camera.width / camera.K[0, 0]))
    # of the film's middle from the principal point, in films; our first pixel's middle is (0, 0)
    aside, below = 0.5 - (camera.K[:2, 2] + 0.5) / (camera.width, camera.height)
    eye = camera.center * SCALE
    vectors = {"origin": eye, "target": eye + camera.R[2], "up": -camera.R[1]}
    look = " ".join(f'{k}="{", ".join(f"{x:.6f}" for x in value)}"' for k, value in vectors.items())
    return (
        f' <sensor type="perspective"><float name="fov" value="{fov:.6f}"/>\n'
        f'  <string name="fov_axis" value="x"/>\n'
        f'  <float name="principal_point_offset_x" value="{aside:.9f}"/>'
        f'<float name="principal_point_offset_y" value="{below:.9f}"/>\n'
        f'  <transform name="to_world"><lookat {look}/></transform>\n'
        f'  <sampler type="independent"><integer name="sample_count" value="{spp}"/>'
        f'</sampler>\n  <film type="hdrfilm"><integer name="width" value="{camera.width}"/>'
        f'<integer name="height" value="{camera.height}"/>'
        '<rfilter type="box"/></film></sensor>\n'
    )
