"""The service under a path prefix, which a proxy removes or leaves."""

from __future__ import annotations

import pytest
from serving import refused, serving
from waiting import until

from reconstruction import Model
from stage_service.api.gate import Access
from stage_service.api.prefix import checked
from stage_service.records.tokens import Tokens


@pytest.mark.parametrize("sent", ["/stage", ""], ids=["left", "removed"])
def test_every_path_is_served_with_and_without_its_prefix(rig_file, tmp_path, world, sent):
    access = Access(Tokens(tmp_path / "none", "the key"), prefix="/stage")
    with serving(rig_file, tmp_path / "root", access) as http:
        page = http.get("/stage")
        assert (page.status_code, page.headers["location"]) == (308, "/stage/")
        assert http.get(f"{sent}/").text == http.get("/stage/").text
        refused(http.get(f"{sent}/captures"), "unauthorized", 401)
        body = {"token": "the key"}
        other = http.post(f"{sent}/login", json=body, headers={"Hairstage-Path": "/other/"})
        assert "with --root-path /other" in refused(other, "http", 421)["detail"]
        http.post(
            f"{sent}/login", json=body, headers={"Hairstage-Path": "/stage/"}
        ).raise_for_status()
        port = http.base_url.port
        assert list(http.cookies) == [f"hairstage-{port}.stage"]
        made = http.post(f"{sent}/captures", json={"plan": {"lights": ["light_000"]}})
        assert made.headers["location"] == f"/stage/captures/{made.json()['id']}"
        assert http.get(made.headers["location"]).json()["id"] == made.json()["id"]
        until(lambda: http.service.capture(made.json()["id"]).outcome == "completed")
        model = Model(http.service.root / "models" / "mine").create()
        model.file("index.html").write_text("its page")
        pipeline = {"name": "light_planes"}
        planes = {"capture": made.json()["id"], "pipeline": pipeline, "model": "mine"}
        job = http.post(f"{sent}/jobs", json=planes).json()["id"]
        folder = f"/stage/jobs/{job}/artifacts/"
        policy = http.get(f"{folder}index.html").headers["content-security-policy"]
        assert f"img-src 127.0.0.1:{port}{folder} data:" in policy  # its own images alone
        assert http.get("/stage/openapi.json").json()["servers"] == [{"url": "/stage"}]
        assert http.post(f"{sent}/devices/blackout").json()["state"] == "dark"
        assert not world.lit
        refused(http.get("/stages/captures"), "http", 404)


@pytest.mark.parametrize("prefix", ["/captures", "/web/x", "stage", "/a b", "/../x", "/a//b"])
def test_a_prefix_that_cannot_be_one_is_refused(prefix):
    with pytest.raises(ValueError, match="--root-path "):
        checked(prefix)


def test_a_slash_at_the_end_is_dropped():
    assert [checked(p) for p in ("", "/", "/stage/", "/a/b-2")] == ["", "", "/stage", "/a/b-2"]
