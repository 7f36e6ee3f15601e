"""Routes of the viewer: its page, and what the page asks about a model."""

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
    """How much of each light: its number, and by what its red, green and blue are multiplied."""

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
        """Its fields. Raises `BadLight` where it has too many pixels."""
        if self.width * self.height > MOST_PIXELS:
            raise BadLight(f"a view may have {MOST_PIXELS} pixels, not {self.width * self.height}")
        return self.model_dump()


class LightInView(Light):
    """Light, and from where it is looked at."""

    view: View


page = APIRouter(include_in_schema=False)
reading = APIRouter(prefix=f"{VIEW}/models", dependencies=READS, tags=["viewer"])
router = APIRouter(prefix=f"{VIEW}/models", dependencies=[Security(caller)], tags=["viewer"])


async def on_viewing(request: Request) -> Viewing:
    """The models that are looked at."""
    viewing: Viewing = request.app.state.viewing
    return viewing


OnViewing = Annotated[Viewing, Depends(on_viewing)]


@dataclass(frozen=True)
class _Model:
    """The model that a route is about, for one caller."""

    name: str
    viewing: Viewing
    yields: bool

    def do(self, operation: str, **options: Any) -> Any:
        """As `Viewing.do`."""
        return self.viewing.do(self.name, operation, yields=self.yields, **options)

    def bytes(self, operation: str, **options: Any) -> Response:
        """The same as an answer."""
        return Response(self.do(operation, **options), media_type="application/octet-stream")


async def viewed_model(name: str, request: Request, viewing: OnViewing) -> _Model:
    """The model that a route is about."""
    return _Model(name, viewing, not owner_of(request.scope).steers)


OnModel = Annotated[_Model, Depends(viewed_model)]


@page.get(VIEW)
def get_page() -> Response:
    """The viewer; which model is in its address."""
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
    """The models that can be looked at."""
    return viewing.names()


@reading.get("/{name}")
def get_about(model: OnModel) -> dict[str, Any]:
    """What there is of a model: its sets of strands, head, cameras, lights, material."""
    about: dict[str, Any] = model.do("about")
    return about


@reading.get("/{name}/strands/{which}", **BYTES)
def get_strands(
    model: OnModel,
    which: str,
    first: Annotated[int, Query(ge=0)] = 0,
    count: Annotated[int, Query(ge=1, le=100_000)] = 2_000,
) -> Response:
    """Some strands, any beginning of which is spread over all: points (uint16, `low + step * p`),
    then lengths and radii (float32, metres), little-endian."""
    return model.bytes("strands", which=which, first=first, count=count)


@reading.get("/{name}/head", **BYTES)
def get_head(model: OnModel) -> Response:
    """The head: two numbers (uint32), vertices (float32), faces (uint32), little-endian."""
    return model.bytes("head")


@reading.get("/{name}/confidence", **BYTES)
def get_confidence(model: OnModel) -> Response:
    """How near a measured point each point of the strands is: 255 at it, 0 at 5 mm and beyond."""
    return model.bytes("confidence")


@reading.get("/{name}/lighting")
def get_lighting(model: OnModel) -> dict[str, Any]:
    """The lights by number, and the hair's material if one was fitted."""
    lighting: dict[str, Any] = model.do("lighting")
    return lighting


@reading.get("/{name}/table", **BYTES)
def get_table(model: OnModel) -> Response:
    """The azimuthal part of the hair's four lobes, by the eye's inclination and the turn."""
    return model.bytes("table")


@reading.get("/{name}/seen/{light}", **BYTES)
def get_seen(model: OnModel, light: int) -> Response:
    """Where a light reaches: 255 or 0 for each point of the strands, then of the head."""
    return model.bytes("seen", light=light)


@reading.post("/{name}/few")
def get_few(model: OnModel, body: Light) -> list[dict[str, Any]]:
    """The few lights that stand for all of these in the shader."""
    few: list[dict[str, Any]] = model.do("few", weights=_named(body))
    return few


@reading.post("/{name}/indirect", **BYTES)
def post_indirect(model: OnModel, body: Light) -> Response:
    """Light between fibres under these lights: of each cell of the box of the strands, x fastest, 9
    coefficients (RGB, float32) of harmonics over the direction in which it leaves. Paths are traced
    when it is first asked for, which takes many seconds."""
    return model.bytes("indirect", weights=_named(body))


@reading.post("/{name}/indirect/view", **BYTES)
def post_indirect_in_view(model: OnModel, body: LightInView) -> Response:
    """Light between fibres under these lights as one view sees it: of hair, then of the head, for
    each pixel its radiance (RGB) times the share that it covers, and that share, a fiftieth of both
    in pixels of the other; float32. Paths are traced for seconds."""
    return model.bytes("indirect_in_view", view=body.view.checked(), weights=_named(body))


@reading.post("/{name}/sums/{camera}.png", **PNG)
def get_sum(model: OnModel, camera: str, body: Light) -> Response:
    """A camera's captured frames under these lights: their sum, exposed, in the sRGB curve."""
    png = model.do("sum", camera=camera, weights=_named(body), exposure=body.exposure)
    return Response(png, media_type="image/png")


@reading.get("/{name}/environments/{which}")
def get_environment(
    model: OnModel, which: str, rotation_deg: Annotated[float, Query(ge=-360, le=360)] = 0.0
) -> dict[int, list[float]]:
    """By what each light is multiplied to stand for the map "studio" or "sky"."""
    return _lit(model.do("environment", which=which, rotation_deg=rotation_deg))


@router.put("/{name}/environments/{file}", openapi_extra=MAP)
async def put_environment(
    model: OnModel,
    viewing: OnViewing,
    file: str,
    request: Request,
    rotation_deg: Annotated[float, Query(ge=-360, le=360)] = 0.0,
) -> dict[int, list[float]]:
    """By what each light is multiplied to stand for this .hdr or .exr map, of at most 4096 × 2048
    pixels. It is not kept."""
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
    """The `weights (L, 3)` of the lights that have any, by their numbers."""
    return {i: w for i, w in enumerate(weights) if any(w)}


def _named(light: Light) -> dict[str, list[float]]:
    """The weights by the lights' numbers, as JSON has them."""
    return {str(number): list(weight) for number, weight in light.weights.items()}
