"""`examples/drive_service.py` against a tiny stage on real wires."""

from __future__ import annotations

import runpy
from pathlib import Path

from serving import serving

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "drive_service.py"


def test_the_service_is_driven_from_python(rig_file, tmp_path, monkeypatch, capsys) -> None:
    with serving(rig_file, tmp_path / "root") as http:
        monkeypatch.setenv("HAIRSTAGE_URL", str(http.base_url))
        runpy.run_path(str(EXAMPLE), run_name="__main__")
        said = capsys.readouterr().out
        capture = http.get("/captures").json()[0]
    assert "6 frames" in said
    assert f"{capture['id']}: completed" in said
    assert (tmp_path / "root" / "captures" / capture["id"] / "manifest.json").is_file()
