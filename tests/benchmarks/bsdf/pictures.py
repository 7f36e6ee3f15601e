"""Pictures of the hair BSDF for docs/explanation/bsdf.md: a sheet of its looks, and white furnaces.

`python -m benchmarks.bsdf.pictures FOLDER` writes `bsdf_sheet.png` and `bsdf_furnace.png`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from appearance import HairAppearance, build_scene
from appearance.metrics.pictures import Row, comparison_picture
from appearance.metrics.scores import srgb
from appearance.scene.hair_scene import SCALE
from reconstruction import Strands
from reconstruction.arrays import Array

ROUGHNESS = (0.05, 0.15, 0.3, 0.6)
ABSORPTION = (0.02, 0.1, 0.4, 2.0)
LIGHTS_DEG = (20.0, 90.0, 160.0)
RADIUS = 0.04


def wig(strands: int, seed: int = 0) -> Strands:
    """Strands that hang over a ball of 4 cm, in some layers."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, 14)
    azimuth = (
        rng.uniform(0, 2 * np.pi, (strands, 1)) + rng.normal(scale=0.03, size=(strands, 1)) * t
    )
    polar = 0.02 + rng.uniform(1.8, 2.2, (strands, 1)) * t
    r = RADIUS * (1 + 0.06 * rng.uniform(size=(strands, 1)))
    flat = r * np.sin(polar)
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), r * np.cos(polar)], -1)
    offsets = len(t) * np.arange(strands + 1)
    return Strands(points.reshape(-1, 3).astype(np.float32), offsets, radius=3e-4)


def pictured(
    shape: Any, bsdf: dict[str, Any], light: dict[str, Any], size: int, spp: int, depth: int
) -> Array:
    """Radiance `(size, size, 3)` of the curves `shape` with a BSDF, seen from the side."""
    shape.set_bsdf(mi.load_dict(bsdf))
    view = mi.ScalarTransform4f().look_at([0, -40, 8], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    scene: Any = mi.load_dict(
        {
            "type": "scene",
            "hair": shape,
            "light": light,
            "sensor": {"type": "perspective", "fov": 13.5, "to_world": view, "film": film},
        }
    )
    integrator: Any = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": depth})
    return np.array(mi.render(scene, integrator=integrator, spp=spp), float)


def fibre(plugin: str, beta: float, sigma_a: float) -> dict[str, Any]:
    """The dictionary of `extended_hair` or stock `hair`; what absorbs is browner than grey."""
    return {
        "type": plugin,
        "longitudinal_roughness": beta,
        "azimuthal_roughness": max(beta, 0.1),
        "sigma_a": {"type": "rgb", "value": [0.6 * sigma_a, sigma_a, 2 * sigma_a]},
    }


def sheet(path: Path, *, size: int = 80, spp: int = 128) -> None:
    """Roughness by absorption by the light's angle from the view."""
    shape = _curves(wig(2500))
    columns = [f"σ {s:g}, {a:.0f}°" for s in ABSORPTION for a in LIGHTS_DEG]
    rows: list[Row] = []
    for beta in ROUGHNESS:
        pictures = {}
        for sigma in ABSORPTION:
            for angle in LIGHTS_DEG:
                turned = np.radians(angle)
                at = SCALE * np.array([np.sin(turned), -np.cos(turned), 0.6])
                light = {"type": "point", "position": at.tolist(), "intensity": 5 * SCALE**2}
                image = pictured(shape, fibre("extended_hair", beta, sigma), light, size, spp, 12)
                pictures[f"σ {sigma:g}, {angle:.0f}°"] = srgb(np.clip(image, 0, 1))
        rows.append((f"β {beta:g}", pictures, {}))
    comparison_picture(path, rows, columns, height=1.2)


def furnaces(path: Path, *, size: int = 96, spp: int = 128) -> list[tuple[float, float, float]]:
    """White hair in uniform light of radiance 1 should vanish: ours beside stock `hair`.

    Grey is 1, black 0.95 and white 1.05. Returns (beta, ours, stock): the means over the pixels
    with hair.
    """
    shape = _curves(wig(150))
    light = {"type": "constant"}
    black = pictured(shape, {"type": "extended_hair", "sigma_a": 1e4}, light, size, 16, 2)
    hair = black.mean(-1) < 0.9
    rows: list[Row] = []
    means = []
    for beta in (0.003, 0.03, 0.3):
        images = {
            name: pictured(shape, fibre(plugin, beta, 0.0), light, size, spp, 100)
            for name, plugin in (("ours", "extended_hair"), ("Mitsuba's hair", "hair"))
        }
        mean = {name: float(image[hair].mean()) for name, image in images.items()}
        captions = {name: f"mean {value:.4f}" for name, value in mean.items()}
        shown = {name: np.clip(0.5 + 10 * (image - 1), 0, 1) for name, image in images.items()}
        rows.append((f"β_M {beta:g}", shown, captions))
        means.append((beta, mean["ours"], mean["Mitsuba's hair"]))
    comparison_picture(path, rows, ["ours", "Mitsuba's hair"], height=2.0)
    return means


def _curves(strands: Strands) -> Any:
    return build_scene(strands, None, hair=HairAppearance((1, 1, 1), 0.3, 0.3)).hair_shape
