"""Files that requests bring, or that lie in the store, made to fill the service's memory."""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import bombs
import httpx
from serving import slug

SHORT = {"lights": ["light_003"], "projectors": []}


def grown(send) -> tuple[httpx.Response, float]:
    """An answer, and by how many MB client and service, one process here, grew meanwhile."""
    responses: list[httpx.Response] = []
    peak = bombs.peak_mb(lambda: responses.append(send()))
    return responses[0], peak


def test_heads_and_masks_are_refused_by_what_they_unpack_to(http, tmp_path):
    http.put("/uploads/s/head.obj", content=bombs.obj(2)).raise_for_status()  # all is loaded
    text = bombs.chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(64 << 20), 1))
    for place, data, why in (
        ("head.obj", bombs.obj(3_800_000), "3,800,000 faces; at most 1,000,000 are read"),
        ("head.obj", bombs.polygon(15_000_000), "line 4: more than 65,536 characters"),
        ("masks/cam_0.png", bombs.png(8, 6, data=b"", more=text)[:-30], "damaged"),
        ("masks/cam_0.png", bombs.png(8, 6, data=text[11:-4]), "more data than these pixels"),
        ("masks/cam_0.png", bombs.png(0xEA60, 0xEA60, data=b""), "8x6 pixels, got 60000x60000"),
    ):
        response, peak = grown(lambda p=place, d=data: http.put(f"/uploads/s/{p}", content=d))
        assert (response.status_code, slug(response)) == (422, "bad-input"), place
        detail = response.json()["detail"]
        assert detail.startswith(f"{place}")
        assert why in detail
        assert peak < 5 * len(data) / 1e6 + 40, place
    (tmp_path / "head.obj").write_bytes(bombs.obj(3_800_000))
    body = {"plan": SHORT, "head": str(tmp_path / "head.obj")}
    response, peak = grown(lambda: http.post("/captures", json=body))
    assert slug(response) == "bad-input"
    assert response.json()["detail"].startswith(f"head: {tmp_path / 'head.obj'}: 3,800,000 faces")
    assert peak < 40
    assert http.get("/captures").json() == []


def test_frames_that_somebody_put_there_are_shown_within_limits(http):
    capture = http.post("/captures", json={"plan": SHORT}).json()["id"]
    shot = Path(http.service._captures.wait(capture, 60).path)
    url = f"/captures/{capture}/frames/2/cam_0"
    http.get(f"{url}.png").raise_for_status()
    frame = shot / "frames/00002/cam_0.exr"
    frame.write_bytes(bombs.exr(64, 16, claimed=(60_000, 60_000)))
    for kind in ("png", "json"):
        response, peak = grown(lambda k=kind: http.get(f"{url}.{k}"))
        assert slug(response) == "damaged-capture"
        expected = f"{frame}: the image unpacks to 60000 × 60000 pixels; at most 160,000,000"
        assert response.json()["detail"].startswith(expected)
        assert peak < 40
    frame.unlink()
    os.mkfifo(frame)
    assert slug(http.get(f"{url}.png")) == "damaged-capture"
    for other in shot.glob("frames/*/cam_1.exr"):
        other.write_bytes(bombs.exr(64, 16, claimed=(60_000, 60_000)))
    response, peak = grown(lambda: http.get(f"/captures/{capture}/board/cam_1"))
    assert slug(response) == "damaged-capture"
    assert peak < 40


def test_a_full_decoder_responds_with_retry_after(http):
    capture = http.post("/captures", json={"plan": SHORT}).json()["id"]
    http.service._captures.wait(capture, 60)
    http.service.decoder.close()
    response = http.get(f"/captures/{capture}/frames/2/cam_0.png")
    assert (response.status_code, slug(response)) == (503, "decoder-busy")
