"""Routes of the viewer: its page, and a model's data for it."""

from __future__ import annotations

import mimetypes
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response, Security
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool

from reconstruction import Light as Lamp
from stage_service.api.downloads import file_response
from stage_service.api.entrance import owner_of
from stage_service.api.gate import VIEW, VIEW_PAGE
from stage_service.api.steering import READS, caller
from stage_service.viewer import BadLight, Viewing
from stage_service.viewer.viewed import MOST_PIXELS
from stage_service.web.headers import PAGE

FILES = Path(__file__).parents[1] / "viewer" / "page"
BYTES: dict[str, Any] = {
    "response_class": Response,
    "responses": {200: {"content": {"application/octet-stream": {}}}},
}

PNG: dict[str, Any] = {
    "response_class": Response,
    "responses": {200: {"content": {"image/png": {}}}},
}
MAP: dict[str, Any] = {"requestBody": {"required": True, "content": {"image/x-exr": {}}}}
Colour = Annotated[list[Annotated[float, Field(ge=0, le=1e9)]], Field(min_length=3, max_length=3)]


class Light(BaseModel):
    """Weights of lights: by number, factors of red, green and blue."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    weights: dict[Annotated[int, Field(ge=0, le=100_000)], Colour] = {}
    exposure: Annotated[float, Field(gt=0, le=1e9)] = 1.0


Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Vector], Field(min_length=3, max_length=3)]


class View(BaseModel):
    """A pinhole camera: pixels, intrinsics, and world to camera (x right, y down, z forward)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    width: Annotated[int, Field(ge=1, le=MOST_PIXELS)]
    height: Annotated[int, Field(ge=1, le=MOST_PIXELS)]
    K: Matrix
    R: Matrix
    t: Vector

    def checked(self) -> dict[str, Any]:
        """Its fields. Raises `BadLight` if it has too many pixels."""
        if self.width * self.height > MOST_PIXELS:
            raise BadLight(f"a view may have {MOST_PIXELS} pixels, got {self.width * self.height}")
        return self.model_dump()


class LightInView(Light):
    """Weights of lights, and the view."""

    view: View


page = APIRouter(include_in_schema=False)
reading = APIRouter(prefix=f"{VIEW}/models", dependencies=READS, tags=["viewer"])
router = APIRouter(prefix=f"{VIEW}/models", dependencies=[Security(caller)], tags=["viewer"])


async def on_viewing(request: Request) -> Viewing:
    """The models of this application."""
    viewing: Viewing = request.app.state.viewing
    return viewing


OnViewing = Annotated[Viewing, Depends(on_viewing)]


@dataclass(frozen=True)
class _Model:
    """A route's model, for one caller."""

    name: str
    viewing: Viewing
    yields: bool

    def do(self, operation: str, **options: Any) -> Any:
        """As `Viewing.do`."""
        return self.viewing.do(self.name, operation, yields=self.yields, **options)

    def bytes(self, operation: str, **options: Any) -> Response:
        """The same as a response."""
        return Response(self.do(operation, **options), media_type="application/octet-stream")


async def viewed_model(name: str, request: Request, viewing: OnViewing) -> _Model:
    """The model of a route."""
    return _Model(name, viewing, not owner_of(request.scope).steers)


OnModel = Annotated[_Model, Depends(viewed_model)]


@page.get(VIEW)
def get_page() -> Response:
    """The viewer; its address names the model."""
    return _file("index.html")


@page.get(VIEW_PAGE + "{file}")
def get_part_of_page(file: str) -> Response:
    """A script or a style of the page."""
    return _file(file)


def _file(name: str) -> Response:
    if name not in {p.name for p in FILES.iterdir()}:
        raise HTTPException(404, f"the viewer's page has no part {name!r}")
    response = file_response(FILES / name, mimetypes.guess_type(name)[0] or "text/plain")
    response.headers.update(PAGE)
    return response


@reading.get("")
def list_viewed(viewing: OnViewing) -> list[str]:
    """Models that can be viewed."""
    return viewing.names()


@reading.get("/{name}")
def get_about(model: OnModel) -> dict[str, Any]:
    """Contents of a model: sets of strands, head, cameras, lights, material."""
    about: dict[str, Any] = model.do("about")
    return about


@reading.get("/{name}/strands/{which}", **BYTES)
def get_strands(
    model: OnModel,
    which: str,
    first: Annotated[int, Query(ge=0)] = 0,
    count: Annotated[int, Query(ge=1, le=100_000)] = 2_000,
) -> Response:
    """Some strands, in an order whose prefixes are spread over the head: points (uint16,
    `low + step * p`), then lengths and radii (float32, metres), little-endian."""
    return model.bytes("strands", which=which, first=first, count=count)


@reading.get("/{name}/head", **BYTES)
def get_head(model: OnModel) -> Response:
    """The head: two numbers (uint32), vertices (float32), faces (uint32), little-endian."""
    return model.bytes("head")


@reading.get("/{name}/confidence", **BYTES)
def get_confidence(model: OnModel) -> Response:
    """Distance of each strand point to the nearest measured point: 255 at 0, 0 from 5 mm on."""
    return model.bytes("confidence")


@reading.get("/{name}/lighting")
def get_lighting(model: OnModel) -> dict[str, Any]:
    """The lights by number, and the hair's material if one was fitted."""
    lighting: dict[str, Any] = model.do("lighting")
    return lighting


@reading.get("/{name}/table", **BYTES)
def get_table(model: OnModel) -> Response:
    """Azimuthal scattering of the hair's four lobes by inclination and azimuth, float32."""
    return model.bytes("table")


@reading.get("/{name}/visibility/{light}", **BYTES)
def get_visibility(model: OnModel, light: int) -> Response:
    """Visibility of a light, 255 or 0 for each point of the strands, then of the head."""
    return model.bytes("visibility", light=light)


@reading.post("/{name}/few")
def get_few(model: OnModel, body: Light) -> list[dict[str, Any]]:
    """The few lights that represent these in the shader."""
    few: list[dict[str, Any]] = model.do("few", weights=_named(body))
    return few


@reading.post("/{name}/indirect/view", **BYTES)
def post_indirect_in_view(model: OnModel, body: LightInView) -> Response:
    """Indirect light under these lights in one view: for hair, then for the head, radiance (RGB)
    times coverage, and coverage, a fiftieth of both in pixels of the other; float32. Takes
    seconds."""
    return model.bytes("indirect_in_view", view=body.view.checked(), weights=_named(body))


@reading.post("/{name}/sums/{camera}.png", **PNG)
def get_sum(model: OnModel, camera: str, body: Light) -> Response:
    """The weighted sum of a camera's OLAT frames, exposed, sRGB."""
    png = model.do("sum", camera=camera, weights=_named(body), exposure=body.exposure)
    return Response(png, media_type="image/png")


@reading.get("/{name}/environments/{which}")
def get_environment(
    model: OnModel, which: str, rotation_deg: Annotated[float, Query(ge=-360, le=360)] = 0.0
) -> dict[int, list[float]]:
    """Weights of the lights that represent the map "studio" or "sky"."""
    return _lit(model.do("environment", which=which, rotation_deg=rotation_deg))


@router.put("/{name}/environments/{file}", openapi_extra=MAP)
async def put_environment(
    model: OnModel,
    viewing: OnViewing,
    file: str,
    request: Request,
    rotation_deg: Annotated[float, Query(ge=-360, le=360)] = 0.0,
) -> dict[int, list[float]]:
    """Weights of the lights that represent this .hdr or .exr map of at most 4096 × 2048 pixels. The
    map is not stored."""
    data, kind = await request.body(), file.rpartition(".")[2].lower()
    if kind not in ("hdr", "exr"):
        raise BadLight(f"an environment map must be .hdr or .exr, got {kind!r}")

    def work() -> dict[int, list[float]]:
        found = enumerate(model.do("lights"))
        lights = [Lamp(f"light_{n}", place, intensity) for n, (place, intensity) in found]
        weights = viewing.decoder.map_weights(data, file, kind, rotation_deg, lights)
        return _lit(weights.tolist())

    return await run_in_threadpool(work)


def _lit(weights: list[list[float]]) -> dict[int, list[float]]:
    """The non-zero `weights (L, 3)` by light number."""
    return {i: w for i, w in enumerate(weights) if any(w)}


def _named(light: Light) -> dict[str, list[float]]:
    """The weights by light number, as JSON keys."""
    return {str(number): list(weight) for number, weight in light.weights.items()}
