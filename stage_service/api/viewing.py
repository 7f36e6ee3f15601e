"""Routes of the viewer: its page, and what the page asks about a model."""

from __future__ import annotations

import mimetypes
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response

from stage_service.api.downloads import file_response
from stage_service.api.gate import VIEW, VIEW_PAGE
from stage_service.api.steering import READS
from stage_service.viewer import Viewed, Viewing

FILES = Path(__file__).parents[1] / "viewer" / "page"
POLICY = "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'"
"""The page loads nothing from another host."""
BYTES: dict[str, Any] = {
    "response_class": Response,
    "responses": {200: {"content": {"application/octet-stream": {}}}},
}

page = APIRouter(include_in_schema=False)
reading = APIRouter(prefix=f"{VIEW}/models", dependencies=READS, tags=["viewer"])


async def on_viewing(request: Request) -> Viewing:
    """The models that are looked at."""
    viewing: Viewing = request.app.state.viewing
    return viewing


OnViewing = Annotated[Viewing, Depends(on_viewing)]


def viewed_model(name: str, viewing: OnViewing) -> Viewed:
    """The model that a route is about; raises `LookupError` where there is none."""
    return viewing.get(name)


OnModel = Annotated[Viewed, Depends(viewed_model)]


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
    response.headers["content-security-policy"] = POLICY
    response.headers["cache-control"] = "no-cache"
    return response


def _bytes(data: bytes) -> Response:
    return Response(data, media_type="application/octet-stream")


@reading.get("")
def list_viewed(viewing: OnViewing) -> list[str]:
    """The models that can be looked at."""
    return viewing.names()


@reading.get("/{name}")
def get_about(model: OnModel) -> dict[str, Any]:
    """What there is of a model: its sets of strands, head, cameras, lights, material."""
    return model.about()


@reading.get("/{name}/strands/{which}", **BYTES)
def get_strands(
    model: OnModel,
    which: str,
    first: Annotated[int, Query(ge=0)] = 0,
    count: Annotated[int, Query(ge=1, le=100_000)] = 2_000,
) -> Response:
    """Some strands, any beginning of which is spread over all: points (uint16, `low + step * p`),
    then lengths and radii (float32, metres), little-endian."""
    return _bytes(model.packed(which).chunk(first, count))


@reading.get("/{name}/head", **BYTES)
def get_head(model: OnModel) -> Response:
    """The head: two numbers (uint32), vertices (float32), faces (uint32), little-endian."""
    return _bytes(model.head_bytes())


@reading.get("/{name}/confidence", **BYTES)
def get_confidence(model: OnModel) -> Response:
    """How near a measured point each point of the strands is: 255 at it, 0 at 5 mm and beyond."""
    return _bytes(model.confidence())
