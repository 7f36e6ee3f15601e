"""The material on a model's page: roughness, colours, and the files that hold them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from reconstruction import Model
from stage_service.model_page.html import Html, element, link

FIELD_FILE = "field.npz"


def material_files(model: Model) -> list[str]:
    """The files that hold the material, in words."""
    if not model.has("appearance.json"):
        return ["no material: no appearance was fitted"]
    if not model.has("hair_maps.npz"):
        return ["the material in ", link("appearance.json"), " (Sun's fit)"]
    more = [" and the lights as found in ", link("lights.json")] if model.has("lights.json") else []
    how = " (inverse rendering)" if _by_inverse_rendering(model) else ""
    return ["the material in ", link("hair_maps.npz"), how, *more]


def _by_inverse_rendering(model: Model) -> bool:
    """Whether its maps are from inverse rendering and not from an edit, which has no report."""
    names = (stage.name for stage in model.report().stages)
    return model.has("hair_maps.npz") and "inverse_rendering" in names


def material(model: Model) -> Iterator[tuple[str, list[str]]]:
    """Roughness and colour of Sun's fit with their errors, and the rendered fit."""
    if not model.has("appearance.json"):
        return
    fit = model.json("appearance.json")
    hair, interval, errors = fit["hair"], fit.get("beta_m_interval"), fit.get("sigma_a_error")
    known = errors is not None
    text: list[str] = [element("b", f"β_M {hair['beta_m']:.2f}"), ", for rendering these strands"]
    if interval:
        text.append(f"; 95 % interval {interval[0]:.2f} to {interval[1]:.2f}")
    yield "roughness", text
    text = [_swatch(fit["colour"]), "σ_a "]
    for k, (value, error) in enumerate(zip(hair["sigma_a"], errors or [None] * 3, strict=True)):
        text += [", " if k else "", element("b", f"{value:.2g}")]
        text.append("" if error is None else f" ± {error:.0%}")
    yield "colour", [*text, "" if known else ", error unknown"]
    yield "skin", [_swatch(fit["skin"]), ", ".join(f"{x:.2f}" for x in fit["skin"])]
    if _by_inverse_rendering(model):
        yield "rendered", ["inverse rendering from the values above: ", *_rendered(model)]
    if model.has(FIELD_FILE):
        yield "field", [link(FIELD_FILE), ": reflectance that the material lacks, also rendered"]


def _rendered(model: Model) -> list[str]:
    """Roughness and colours, from root to tip, of the maps."""
    from appearance.bsdf.longitudinal import colour_of_absorption
    from appearance.bsdf.maps import HairMaps

    maps, _ = HairMaps.load(model)
    layers = maps.sigma_a.mean(axis=(1, 2))  # of all cells of the scalp
    names = ("root", "middle", "tip") if len(layers) > 1 else ("colour",)
    out: list[str] = [element("b", f"β_M {maps.beta_m:.2f}")]
    for k, name in enumerate(names):
        layer = layers[k * (len(layers) - 1) // 2]
        out += [f"; {name} ", _swatch(colour_of_absorption(layer, maps.beta_n).tolist()), "σ_a "]
        out.append(", ".join(f"{x:.2g}" for x in layer))
    return out


def _swatch(linear: Sequence[float]) -> Html:
    """A patch of a linear RGB colour."""
    shown = [12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in linear]
    red, green, blue = (round(255 * min(max(x, 0), 1)) for x in shown)
    return element("span", class_="swatch", style=f"background:rgb({red},{green},{blue})")
