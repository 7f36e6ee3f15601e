"""Tables of lights as spreadsheets write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reconstruction.files.lights import LightFileError, read_lights


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path: Path) -> None:
    path = tmp_path / "lights.csv"
    path.write_text("\ufeffname,x,y,z\nlight_005,0,1,2\nlight_002,3,4,5\n", encoding="utf-8")
    found = read_lights(path).lights
    assert [light.name for light in found] == ["light_005", "light_002"]
    np.testing.assert_array_equal(found[1].position, (3, 4, 5))


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
    with pytest.raises(LightFileError, match=r"row 1: 0.5 is ambiguous"):
        read_lights(path)
    path.write_text("-812 1500 300 2\n-500 1400 200 2\n")  # whole millimetres
    with pytest.raises(LightFileError, match=r"row 1: -812 is ambiguous"):
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
