"""What the viewer's page asks: strands, head, confidence; and who may ask."""

from __future__ import annotations

import json
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest

from reconstruction import Model, Strands
from reconstruction.light_planes.point_cloud import PointCloud
from stage_service.cli import main
from stage_service.cli.stage import processes
from stage_service.viewer.packing import PackedStrands

STRANDS = "/view/models/bristles/strands/model"


def test_strands_come_back_in_metres(http, model):
    description = http.get("/view/models/bristles").json()["strands"]["model"]
    n = description["points"]
    data = http.get(STRANDS, params={"count": description["count"]}).content
    packed = np.frombuffer(data, "<u2", description["count"] * n * 3).reshape(-1, n, 3)
    places = np.array(description["low"]) + description["step"] * packed
    strands = model.strands()
    ends = strands.points[strands.offsets[1:] - 1]
    nearest = np.linalg.norm(places[:, -1][:, None] - ends[None], axis=-1).min(axis=0)
    assert len(packed) == len(strands)
    assert nearest.max() < 1e-5
    np.testing.assert_allclose(np.linalg.norm(places[:, 0], axis=1), 0.08, atol=1e-5)


def test_truth_head_and_what_is_not_there(http):
    assert len(http.get("/view/models/bristles/strands/truth").content) > 0
    vertices, faces = np.frombuffer(http.get("/view/models/bristles/head").content[:8], "<u4")
    assert (vertices, faces) == (288, 506)
    for absent in (
        "/view/models/other",
        "/view/models/bristles/strands/x",
    ):
        assert http.get(absent).status_code == 404
    assert "not made from a sweep" in http.get("/view/models/bristles/confidence").json()["detail"]


def test_without_the_key_the_page_comes_and_the_model_does_not(http):
    nobody = {"Authorization": ""}
    assert http.get("/view", headers=nobody).status_code == 200
    script = http.get("/view/page/viewer.js", headers=nobody)
    assert script.status_code == 200
    assert "javascript" in script.headers["content-type"]
    assert http.get("/view/page/../../../etc/passwd", headers=nobody).status_code in (401, 404)
    assert http.get(STRANDS, headers=nobody).status_code == 401
    assert http.get("/view/models", headers=nobody).status_code == 401


def test_the_address_holds_whatever_name_a_model_has(tmp_path, monkeypatch, capsys):
    model = Model(tmp_path / "long hair & 100% #2").create()
    model.write_strands(Strands.from_list([np.array([[0, 0, 0], [0, 0, 0.1]])]))
    monkeypatch.setattr(processes, "exit_on_sigterm", lambda: None)
    assert main(["view", str(model), "--port", "70000"]) == 3
    assert "expected 0 to 65535" in capsys.readouterr().err

    def serve(viewing, access, port, ready):
        ready("http://127.0.0.1:1")

    monkeypatch.setattr("stage_service.api.app.serve_viewer", serve)
    assert main(["view", str(model), "--json"]) == 0
    url = json.loads(capsys.readouterr().out)["url"]
    assert parse_qs(urlsplit(url).fragment)["model"] == [model.path.name]  # as the page reads it


def test_confidence_is_the_distance_to_measured_points(http, model: Model):
    """Points are measured along one strand alone: full there, none elsewhere."""
    strands = model.strands()
    along = strands[7].astype(float)
    points = along[0] + (along[-1] - along[0]) * np.linspace(0, 1, 200)[:, None]
    n = len(points)
    ones, zeros = np.ones(n), np.zeros(n)
    cloud = PointCloud(
        *(points, np.tile(np.eye(3) * 1e-8, (n, 1, 1)), np.tile([0.0, 0, 1], (n, 1))),
        *(np.zeros((n, 2)), zeros, zeros, zeros, zeros, ones, ones, ("a",), ("b",)),
    )
    model.write_points(cloud)
    description = http.get("/view/models/bristles").json()["strands"]["model"]
    level = np.frombuffer(http.get("/view/models/bristles/confidence").content, np.uint8)
    level = level.reshape(-1, description["points"])
    order = PackedStrands.of(strands).order
    own = level[np.flatnonzero(order == 7)[0]]
    assert own.min() >= 240
    tips = strands.points[strands.offsets[1:] - 1].astype(float)
    far = np.linalg.norm(tips - along[-1], axis=1) > 0.02
    assert level[far[order], -1].max() == 0


@pytest.mark.parametrize("path", ["index.html", "../viewed.py", "style.css"])
def test_only_parts_of_the_page_are_given(http, path):
    wanted = 404 if ".." in path else 200
    assert http.get(f"/view/page/{path}").status_code == wanted


def test_light_that_cannot_be_made_is_refused_with_what_is_wrong(http):
    base = "/view/models/bristles"
    wrong = http.put(f"{base}/environments/a.exr", content=b"no map")
    assert (wrong.status_code, wrong.json()["title"]) == (
        *(422, "A file or name in the request cannot be used"),
    )
    assert "hdr" in http.put(f"{base}/environments/a.jpg", content=b"x").json()["detail"]
    assert "studio or sky" in http.get(f"{base}/environments/mars").json()["detail"]
    assert http.post(f"{base}/few", json={"weights": {"400": [1, 1, 1]}}).status_code == 422
    assert http.post(f"{base}/few", json={"weights": {"4": [1, 1]}}).status_code == 422
    assert http.get(f"{base}/visibility/400").status_code == 404
    assert http.get(f"{base}/table").status_code == 404  # no material was fitted


def test_a_view_that_is_none_is_refused_before_a_path_is_traced(http):
    lens = [[100, 0, 5], [0, 100, 5], [0, 0, 1]]
    view = {"width": 9, "height": 9, "K": lens, "R": np.eye(3).tolist(), "t": [0, 0, 1]}

    def request_body(**what):
        body = {"weights": {"4": [1, 1, 1]}, "view": {**view, **what}}
        response = http.post("/view/models/bristles/indirect/view", json=body)
        return response.status_code, response.json()["detail"]

    assert request_body()[0] == 404  # no material was fitted
    assert request_body(R=[[1, 0, 0], [0, 1, 0], [0, 1, 1]])[0] == 422
    assert request_body(width=0)[0] == 422
    status, detail = request_body(width=1000, height=101)
    assert status == 422
    assert "101000" in detail


def test_a_map_becomes_lights_of_its_power(http):
    image = np.full((8, 16, 3), 0.5, np.float32)
    data = cv2.imencode(".hdr", image)[1].tobytes()
    weights = http.put("/view/models/bristles/environments/even.hdr", content=data).json()
    few = http.post("/view/models/bristles/few", json={"weights": weights}).json()
    assert len(few) == 8
    power = sum(np.array(x["intensity"]) / np.square(x["position"]).sum() for x in few)
    np.testing.assert_allclose(power, 4 * np.pi * 0.5, rtol=0.01)
