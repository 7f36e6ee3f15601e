"""Links in the store are listed, removed as links, never read through; the trash can be emptied."""

from __future__ import annotations

import json
import shutil
import tarfile
from io import BytesIO
from pathlib import Path

import pytest
from serving import Client, serving, slug

from reconstruction import Model, Strands
from stage_service import trash

SHORT = {"lights": ["light_003"], "projectors": []}
SECRET = b"root:x:0:0"


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder that is nobody's on the web."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "passwd").write_bytes(SECRET)
    (folder / "index.html").write_bytes(SECRET)
    return folder


def link(http: Client, place: str, to: Path | str) -> Path:
    path = http.service.root / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(to)
    return path


def shot(http: Client) -> Path:
    capture = http.post("/captures", json={"plan": SHORT}).json()["id"]
    return Path(http.service._captures.wait(capture, 60).path)


def test_a_model_that_is_a_link_is_listed_with_where_it_leads_and_not_read(http, outside):
    capture = shot(http).name
    place = link(http, "models/linked", outside)
    link(http, "models/broken", "/nowhere")
    reported = {m["name"]: m for m in http.get("/models").json()}
    assert reported["linked"] == {
        **{"name": "linked", "files": [], "bytes": 0, "link": str(outside), "outside": []}
    }
    assert reported["broken"]["link"] == "/nowhere"
    requested = {"capture": capture, "pipeline": {"name": "reconstruct"}, "model": "linked"}
    responses = [
        http.get("/models/linked/archive.tar"),
        http.get("/models/broken/archive.tar"),
        http.get("/view/models/linked"),
        http.post("/jobs", json=requested),
    ]
    for response in responses:
        assert (response.status_code, slug(response)) == (409, "leads-outside")
        assert SECRET not in response.content
    assert f"the model linked is a link to {outside}" in responses[0].json()["detail"]
    job = http.post("/jobs", json={**requested, "model": "plain"}).json()["id"]
    Model(http.service.root / "models" / "plain")
    link(http, "models/plain", outside)  # after the job was taken
    for path in ("artifacts", "artifacts/passwd", "artifacts/index.html", "report"):
        assert slug(http.get(f"/jobs/{job}/{path}")) == "leads-outside"
    assert place.is_symlink()


def test_links_in_a_model_that_lead_out_of_it_are_named_and_not_read(http, outside):
    model = Model(http.service.root / "models" / "m").create()
    model.write_strands(Strands.from_list([[[0, 0, 0], [0, 0, 1]]], radius=1e-4))
    link(http, "models/m/relit.png", outside / "passwd")
    link(http, "models/m/plots", outside)
    link(http, "models/m/same.npz", "strands.npz")
    link(http, "models/m/loop", ".")
    (reported,) = http.get("/models").json()
    assert reported["outside"] == [f"plots -> {outside}", f"relit.png -> {outside / 'passwd'}"]
    assert "relit.png" not in reported["files"]
    for path in ("/models/m/archive.tar", "/view/models/m"):
        response = http.get(path)
        assert slug(response) == "leads-outside"
        assert SECRET not in response.content
        assert str(outside) in response.json()["detail"]
    for name in ("relit.png", "plots"):
        (model.path / name).unlink()
    archive = http.get("/models/m/archive.tar")
    with tarfile.open(fileobj=BytesIO(archive.content)) as tar:
        assert "m/same.npz" in tar.getnames(), "a link that stays inside is a file like others"


def test_a_capture_that_is_a_link_is_listed_and_removed_as_one(rig_file, tmp_path, outside):
    root = tmp_path / "root"
    with serving(rig_file, root) as http:
        real = shot(http)
        moved = shutil.copytree(real, tmp_path / "moved")
        link(http, "captures/20200101-000000-away", moved)
        link(http, "captures/20200101-000000-same", real.name)
        link(http, "captures/20200101-000000-gone", "/nowhere")
        link(http, "captures/etc", outside)
    with serving(rig_file, root) as http:  # and as a service finds them that has an index
        reported = {c["id"]: c for c in http.get("/captures").json()}
        leads = {"20200101-000000-away": moved, "20200101-000000-same": real.name}
        leads |= {"20200101-000000-gone": "/nowhere", "etc": outside}
        for name, to in leads.items():
            assert reported[name]["outcome"] == "damaged"
            assert f"is a link to {to}" in reported[name]["error"]
            for path in ("archive.tar", "steps", "frames/2/cam_0.exr", "frames/2/cam_0.png"):
                assert slug(http.get(f"/captures/{name}/{path}")) == "leads-outside", path
            removed = http.delete(f"/captures/{name}").json()
            assert removed["link"] == str(to)
        assert [c["id"] for c in http.get("/captures").json()] == [real.name]
        back = next(r for r in http.get("/trash").json() if r["id"] == "20200101-000000-gone")
        http.post(f"/trash/{back['name']}/restore").raise_for_status()
        assert (root / "captures" / back["id"]).readlink() == Path("/nowhere")
        assert len(http.delete("/trash", params={"older_than_days": 0}).json()) == 3
        assert (moved / "plan.json").is_file()
        assert (real / "plan.json").is_file()
        assert (outside / "passwd").read_bytes() == SECRET


def test_a_capture_put_there_later_that_is_a_link_is_not_read(http, outside):
    link(http, "captures/late", shot(http).name)
    assert slug(http.get("/captures/late/steps")) == "leads-outside"


def test_an_upload_that_is_a_link_is_neither_read_nor_written_through(http, outside):
    link(http, "uploads/linked", outside)
    head = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    assert http.get("/uploads").json()[0]["link"] == str(outside)
    assert slug(http.put("/uploads/linked/head.obj", content=head)) == "leads-outside"
    assert slug(http.post("/captures", json={"plan": SHORT, "upload": "linked"})) == "leads-outside"
    assert http.delete("/uploads/linked").status_code == 200
    assert http.get("/uploads").json() == []
    http.put("/uploads/s/head.obj", content=head).raise_for_status()
    link(http, "uploads/s/masks", outside)
    assert slug(http.post("/captures", json={"plan": SHORT, "upload": "s"})) == "leads-outside"
    assert http.delete("/uploads/s").status_code == 200
    assert sorted(p.name for p in outside.iterdir()) == ["index.html", "passwd"]


def test_undeletable_trash_is_named_and_younger_trash_is_deleted(http, monkeypatch):
    for name in ("old", "young"):
        Model(http.service.root / "models" / name).create()
        http.delete(f"/models/{name}").raise_for_status()
    old, young = http.get("/trash").json()
    delete, stuck = trash.remove, http.service.root / "trash" / old["name"]

    def remove(path: Path) -> None:
        if path.is_relative_to(stuck):
            raise PermissionError(13, "Permission denied", str(path))
        delete(path)

    monkeypatch.setattr(trash, "remove", remove)
    response = http.delete("/trash", params={"older_than_days": 0})
    assert (response.status_code, slug(response)) == (409, "not-removed")
    (problem,) = response.json()["problems"]
    assert problem.startswith(f"{old['name']} (model old)")
    assert "Permission denied" in problem
    (left,) = http.get("/trash").json()
    assert left["id"] == "old"
    assert not (http.service.root / "trash" / young["name"]).exists()
    audit = {(a["action"], a["subject"]): a["result"] for a in http.get("/audit").json()}
    assert audit["model.delete", "old"] == "refused"
    monkeypatch.undo()
    assert len(http.delete("/trash", params={"older_than_days": 0}).json()) == 1


def test_whatever_a_crash_left_in_the_trash_is_listed_and_goes(http, outside):
    root = http.service.root
    for name in ("moved", "halved", "unread"):
        Model(root / "models" / name).create().write_json("results.json", {})
        http.delete(f"/models/{name}").raise_for_status()
    places = {r["id"]: root / "trash" / r["name"] for r in http.get("/trash").json()}
    shutil.rmtree(places["moved"] / "moved")  # or it was never moved here
    (places["halved"] / "halved").rename(places["halved"] / trash.DELETING)
    (places["unread"] / "removed.json").write_text("{")
    (root / "trash" / "empty").mkdir()
    link(http, "trash/link", outside)
    (root / "trash" / "file").write_text("x")
    evil = root / "trash" / "evil"
    evil.mkdir()
    record = {"name": None, "kind": "model", "id": "..", "by": "", "removed": "2020", "bytes": 0}
    (evil / "removed.json").write_text(json.dumps(record))
    reported = {r["name"]: r for r in http.get("/trash").json()}
    assert len(reported) == 7
    assert reported[places["moved"].name]["problem"].startswith("its files are not here")
    assert reported[places["halved"].name]["problem"] == "its deletion was interrupted"
    assert reported["link"]["link"] == str(outside)
    for name in ("empty", "link", "file", "evil", places["unread"].name):
        assert reported[name]["kind"] == "unknown"
    for name in reported:
        response = http.post(f"/trash/{name}/restore")
        assert slug(response) == "not-there"
        assert "cannot be restored" in response.json()["detail"]
    assert len(http.delete("/trash", params={"older_than_days": 0}).json()) == 7
    assert list((root / "trash").iterdir()) == []
    assert (outside / "passwd").read_bytes() == SECRET
