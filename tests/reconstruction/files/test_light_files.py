"""Tables of lights as spreadsheets write them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from reconstruction import Camera, Rig
from reconstruction.files.lights import LightFileError, read_lights


def test_a_spreadsheet_may_have_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    path = tmp_path / "lights.csv"
    path.write_text("name;x;y;z;intensity\nkey;1,5;-2;0,25;3\nfill; 0;1,0;2;0,5\n")
    key, fill = read_lights(path).lights
    assert (key.name, fill.name) == ("key", "fill")
    assert key.position.tolist() == [1.5, -2, 0.25]
    assert fill.intensity.tolist() == [0.5, 0.5, 0.5]


def test_four_numbers_are_a_name_and_a_place_only_where_the_first_may_be_a_name(
    tmp_path: Path,
) -> None:
    path = tmp_path / "lights.txt"
    path.write_text("5 1.0 1.2 0.3\n")
    assert read_lights(path).lights[0].name == "light_005"
    path.write_text("0.5 1.0 1.2 300\n")
    with pytest.raises(LightFileError, match=r"line 1: 0.5 is ambiguous"):
        read_lights(path)
    path.write_text("-812 1500 300 2\n-500 1400 200 2\n")  # whole millimetres
    with pytest.raises(LightFileError, match=r"line 1: -812 is ambiguous"):
        read_lights(path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("lights.csv", "name,x,y,z,intensity\nkey,1,0,1,7\nfill,0,1,1,\n"),
        ("lights.json", '{"key": {"position": [1, 0, 1], "intensity": 7}, "fill": [0, 1, 1]}'),
    ],
)
def test_a_light_without_an_intensity_beside_others_with_one_is_named(tmp_path, name, text) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(LightFileError, match=r"light 2 \(fill\) has no intensity, others have"):
        read_lights(path)


MM = [[100, -1300, 250], [1270, 0, 508]]


@pytest.mark.parametrize(
    ("name", "text", "unit"),
    [
        ("a.csv", "id,x_mm,y_mm,z_mm\n7,100,-1300,250\n12,1270,0,508\n", 0.001),
        ("a.csv", "id,x/mm,y/mm,z/mm\n7,100,-1300,250\n12,1270,0,508\n", 0.001),
        ("a.json", '[{"id": 7, "unit": "mm", "position": [100, -1300, 250]}, '
                   '{"id": 12, "units": "millimetres", "x": 1270, "y": 0, "z": 508}]', 0.001),
        ("a.csv", "x [mm];Y (mm);z mm;Light ID\n100;-1300;250,0;07\n1270;0;508;12\n", 0.001),
        ("a.txt", "# id x_cm y_cm z_cm\n7.0 10 -130 25\n12.0 127 0 50.8\n", 0.01),
        ("a.csv", "pos_x_m\tpos_y_m\tpos_z_m\tlight\n.1\t-1.3\t.25\t7\n1.27\t0\t.508\t12\n", 1.0),
        ("a.csv", "z_in,y_in,x_in,id\n9.84251969,-51.1811024,3.93700787,7\n20,0,50,12\n", 0.0254),
        ("a.csv", "\n# of Tuesday\nid,x,y,z,\n7,.1,-1.3,.25,\n\n12,1.27,0,.508,\n", None),
        ("a.csv", "7,.1,-1.3,.25\n12,1.27,0,.508\n", None),
        ("a.json", '[{"id": 7, "x_mm": 100, "y_mm": -1300, "z_mm": 250}, '
                   '{"id": "12", "x_mm": 1270, "y_mm": 0, "z_mm": 508}]', 0.001),
        ("a.json", '{"units": {"position": "mm"}, "lights": [{"id": 7, "position": '
                   '[100, -1300, 250]}, {"id": 12, "position": [1270, 0, 508]}]}', 0.001),
        ("a.json", '\ufeff{"07": {"position_cm": [10, -130, 25]}, '
                   '"light_012": {"position_cm": [127, 0, 50.8]}}', 0.01),
    ],
)  # fmt: skip
def test_columns_are_read_by_name_and_unit(tmp_path: Path, name: str, text: str, unit) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    found = read_lights(tmp_path / name)
    assert [light.name for light in found.lights] == ["light_007", "light_012"]
    assert found.metres == unit
    metres = np.array([light.position for light in found.lights]) * (unit or 1)
    np.testing.assert_allclose(metres, np.array(MM) / 1000, rtol=1e-8)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("id,x_mm,y_mm,z_mm\n7,1,2\n", "line 2 has 3 columns, the header has id, x_mm"),
        ("id,x_mm,y_cm,z_mm\n7,1,2,3\n", "expected one unit for x, y and z"),
        ("id,x_mm,y_mm,z_mm,x_cm\n7,1,2,3,4\n", "give a position twice"),
        ("id,x_km,y_km,z_km\n7,1,2,3\n", "line 1: expected a number, got 'x_km'; a header"),
        ("id,x_mm,y_mm,z_mm\n\n7,1,2,one\n", "line 3: expected a number, got 'one'"),
        ("id,x_mm,y_mm,z_mm\n7,1,2,3\n07,3,4,5\n", "two lights have the name 'light_007'"),
    ],
)
def test_a_table_that_is_not_clear_is_refused_at_its_line(tmp_path, text: str, words: str) -> None:
    (tmp_path / "lights.csv").write_text(text)
    with pytest.raises(LightFileError, match=words):
        read_lights(tmp_path / "lights.csv")


def test_columns_that_are_not_used_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("id,x,y,z,power,red,green,blue\n7,1,2,3,40,1,2,3\n")
    found = read_lights(tmp_path / "a.csv")
    assert found.lights[0].intensity.tolist() == [1, 2, 3]
    assert "not used of its lights: power" in found.notes[0]


S = np.array([[-219.4, -57.9, 517.0], [213.1, -181.9, 444.7]])
AIMS = np.array([[0.96, -0.1, 0.24], [-0.66, 0.58, 0.47]])
PHI = np.array([[4.1e7, 7.4e7, 4.7e7], [3.1e7, 5.4e7, 3.3e7]])


def write_csv(path: Path) -> None:
    rows = [
        ",".join(map(str, [i, *place, *aim, 1.5, *phi]))
        for i, (place, aim, phi) in enumerate(zip(S, AIMS, PHI, strict=True))
    ]
    path.write_text("\n".join(["id,x,y,z,aim_x,aim_y,aim_z,mu,r,g,b", *rows]) + "\n")


def write_json(path: Path) -> None:
    entries = [
        {"position": p, "direction": a, "mu": 1.5, "intensity": phi}
        for p, a, phi in zip(S.tolist(), AIMS.tolist(), PHI.tolist(), strict=True)
    ]
    path.write_text(json.dumps({"lights": entries}))


def write_mat(path: Path) -> None:
    savemat(path, {"S": S, "Dir": AIMS, "mu": np.full((2, 1), 1.5), "Phi": PHI})


@pytest.mark.parametrize(
    ("name", "write"),
    [("lights.csv", write_csv), ("lights.json", write_json), ("lights.mat", write_mat)],
)
def test_lights_with_an_axis_shine_as_a_power_of_the_cosine(
    name: str, write: Callable[[Path], None], tmp_path: Path
) -> None:
    write(tmp_path / name)
    found = read_lights(tmp_path / name)
    assert found.notes == []
    for light, place, aim, phi in zip(found.lights, S, AIMS, PHI, strict=True):
        np.testing.assert_allclose(light.position, place)
        towards = np.array([0.3, 0.4, 0.5])
        cosine = max(0.0, towards @ aim / np.linalg.norm(aim) / np.linalg.norm(towards))
        shines = light.intensity_towards(place + 40 * towards)
        np.testing.assert_allclose(shines, phi * cosine**1.5, rtol=1e-4)
    assert found.lights[0].profile is found.lights[1].profile
    rig = Rig("near", (Camera.look_at("cam", 8, 8, [1, 0, 0], [0, 0, 0], 20),), (*found.lights,))
    again = Rig.from_dict(json.loads(json.dumps(rig.to_dict())))
    np.testing.assert_array_equal(
        again.lights[1].intensity_towards(S[0]), rig.lights[1].intensity_towards(S[0])
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[{"position": [0, 0, 1], "mu": 1}]', "mu needs an aim"),
        ('[{"position": [0, 0, 1], "aim": [0, 0, 0]}]', "expected a direction"),
        ('[{"position": [0, 0, 1], "aim": [0, 1, 0], "mu": -1}]', "power of a cosine lobe"),
    ],
)
def test_wrong_axes_are_named(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "lights.json").write_text(text)
    with pytest.raises(LightFileError, match=said):
        read_lights(tmp_path / "lights.json")


def test_other_matlab_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "lights.mat"
    savemat(path, {"K": np.eye(3)})
    with pytest.raises(LightFileError, match=r"expected S \(N, 3\)"):
        read_lights(path)
    path.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(40))
    with pytest.raises(LightFileError, match="not a MATLAB file of lights"):
        read_lights(path)
    savemat(path, {"S": S, "Dir": AIMS[:1]})
    with pytest.raises(LightFileError, match="expected S"):
        read_lights(path)
