"""The console's static files: ES modules without a build step, which use the API."""

from __future__ import annotations

import mimetypes
from pathlib import Path

from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse

from stage_service.web.headers import PAGE

STATIC = Path(__file__).with_name("static")
FILES = {path.name: path for path in STATIC.iterdir() if path.is_file()}
FOLDER = "/web/"
PAGES = {"/": "index.html", "/docs": "docs.html", "/favicon.ico": "icon.svg"}
router = APIRouter(include_in_schema=False)


@router.get(FOLDER + "{name}")
def get_file(name: str) -> FileResponse:
    """A script, style sheet or picture of the pages."""
    if name not in FILES:
        raise HTTPException(404, f"the console has no file {name!r}")
    kind = "text/javascript" if name.endswith(".js") else mimetypes.guess_type(name)[0]
    return FileResponse(FILES[name], media_type=kind, headers=PAGE)


@router.get("/")
def console() -> FileResponse:
    """The operator's console."""
    return get_file(PAGES["/"])


@router.get("/docs")
def docs() -> FileResponse:
    """The API, from /openapi.json."""
    return get_file(PAGES["/docs"])


@router.get("/favicon.ico")
def icon() -> FileResponse:
    """The icon of pages that name none."""
    return get_file(PAGES["/favicon.ico"])
