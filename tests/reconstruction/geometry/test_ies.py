"""IES files: every edition and symmetry, exact at the nodes, no seam; errors name file and line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reconstruction import Rig
from reconstruction.geometry.ies import IesError, read_ies
from reconstruction.geometry.light_profiles import LightProfile
from reconstruction.geometry.rig import RigError

VERTICAL = (0.0, 30.0, 60.0, 90.0)


def text(
    horizontal=(0.0,),
    vertical=VERTICAL,
    values=None,
    *,
    first="IESNA:LM-63-2002",
    labels=("[TEST] written by a test",),
    tilt="TILT=NONE",
    head=(1, 1000, 1),
    kind=1,
    units=2,
    ballast=(1, 1, 20),
):
    """An LM-63 file; `values` (H, V) default to a different number at every node."""
    if values is None:
        values = 100 + np.arange(len(horizontal) * len(vertical)).reshape(len(horizontal), -1)
    rows = [
        *([first] if first else []),
        *labels,
        tilt,
        " ".join(map(str, (*head, len(vertical), len(horizontal), kind, units, 0.1, 0.2, 0.0))),
        " ".join(map(str, ballast)),
        " ".join(map(str, vertical)),
        " ".join(map(str, horizontal)),
        *(" ".join(map(str, row)) for row in np.asarray(values)),
    ]
    return "\n".join(rows) + "\n"


def write(folder: Path, content: str) -> Path:
    path = folder / "lamp.ies"
    path.write_text(content, encoding="latin-1")
    return path


def towards(horizontal, vertical):
    """Type C direction in the lamp's frame (right, down, forward)."""
    h, v = np.radians(horizontal), np.radians(vertical)
    return np.stack(
        np.broadcast_arrays(np.sin(v) * np.cos(h), -np.sin(v) * np.sin(h), np.cos(v)), -1
    )


@pytest.mark.parametrize(
    ("first", "version"),
    [
        ("", 1986),
        ("IESNA91", 1991),
        ("IESNA:LM-63-1995", 1995),
        ("IESNA:LM-63-2002", 2002),
        ("IES:LM-63-2019", 2019),
    ],
)
def test_every_edition_is_read_and_its_factors_applied(tmp_path, first, version):
    labels = ("a lamp of 1986, its label lines free",) if version == 1986 else ("[LAMP] LED",)
    content = text(first=first, labels=labels, head=(2, -1, 3), ballast=(0.5, 1.1, 20), units=1)
    found = read_ies(write(tmp_path, content))
    # the third factor became a mark of how the file was made
    factor = 1.5 * (1.1 if version <= 1995 else 1.0)
    assert found.at([0, 0, 1]) == pytest.approx(100 * factor)
    assert found.unit == "cd"


@pytest.mark.parametrize(
    ("horizontal", "fold"),
    [
        ((0,), lambda h: 0 * h),
        ((0, 40, 90), lambda h: 90 - np.abs(np.abs((h % 360) - 180) - 90)),
        ((0, 45, 110, 180), lambda h: 180 - np.abs((h % 360) - 180)),
        ((90, 120, 200, 270), lambda h: np.where(np.abs(h % 360 - 180) > 90, 180 - h, h) % 360),
        ((0, 50, 170, 270, 360), lambda h: h % 360),
        ((0, 50, 170, 345), lambda h: h % 360),
    ],
    ids=["axial", "quadrants", "two halves", "halves 90-270", "full", "full, not closed"],
)
def test_symmetry_is_expanded_and_nodes_are_exact(tmp_path, horizontal, fold):
    values = 100.0 + np.arange(len(horizontal) * 4).reshape(-1, 4)
    values[:, 0] = 50
    if horizontal[-1] == 360:
        values[-1] = values[0]
    profile = read_ies(write(tmp_path, text(horizontal, values=values)))
    for h, row in zip(horizontal, values, strict=True):
        np.testing.assert_allclose(profile.at(towards(h, VERTICAL)), row, rtol=1e-12)
    around = np.arange(0.0, 360.0, 1.0)
    for other in (around, -around, around + 720):
        folded = fold(other)
        np.testing.assert_allclose(
            profile.at(towards(other, 47.0)), profile.at(towards(folded, 47.0)), rtol=1e-9
        )
    near = profile.at(towards(np.array([-1e-7, 0, 1e-7]), 47.0))
    np.testing.assert_allclose(near, near[1], rtol=1e-6)  # no seam
    assert not profile.at(towards(around, 91.0)).any()


@given(h=st.floats(-720, 720), v=st.floats(0.01, 179.99))
def test_longitudes_are_periodic(h: float, v: float) -> None:
    profile = LightProfile(
        "p", np.array([90.0, 200, 300, 450]), np.array([0.0, 90, 180]), np.ones((4, 3))
    )
    assert profile.at(towards(h, v)) == pytest.approx(1)


@pytest.mark.parametrize(("kind", "letter"), [(3, "A"), (2, "B")])
def test_types_a_and_b_look_forward_right_and_up(tmp_path, kind, letter):
    angles = (-90.0, -20.0, 0.0, 40.0, 90.0)
    content = text(angles, angles, kind=kind)
    profile = read_ies(write(tmp_path, content))
    assert profile.photometry == letter
    values = 100 + np.arange(25.0).reshape(5, 5)
    h, v = np.radians(np.meshgrid(angles[1:4], angles[1:4], indexing="ij"))
    if letter == "A":
        right, up, ahead = np.cos(v) * np.sin(h), np.sin(v), np.cos(v) * np.cos(h)
    else:
        right, up, ahead = np.sin(h), np.cos(h) * np.sin(v), np.cos(h) * np.cos(v)
    found = profile.at(np.stack([right, -up, ahead], -1))
    np.testing.assert_allclose(found, values[1:4, 1:4], rtol=1e-12)
    assert profile.at([0, 0, -1]) == 0
    one_side = read_ies(write(tmp_path, text(angles[2:], angles, kind=kind)))
    np.testing.assert_allclose(
        one_side.at([[0.3, 0.2, 1], [0.9, -0.5, 1]]), one_side.at([[-0.3, 0.2, 1], [-0.9, -0.5, 1]])
    )


def test_flux_is_the_integral(tmp_path):
    flat = read_ies(write(tmp_path, text(vertical=(0, 80, 180), values=[[5, 5, 5]])))
    assert flat.flux == pytest.approx(5 * 4 * np.pi, rel=1e-12)
    beam = read_ies(write(tmp_path, text((0, 60, 90), values=None)))
    n = 1200
    c = (np.arange(n) + 0.5) * np.pi / n
    phi = (np.arange(n) + 0.5) * 360 / n
    numeric = (
        (beam.at(towards(phi[:, None], np.degrees(c))) * np.sin(c)).sum() * 2 * np.pi**2 / n**2
    )
    assert beam.flux == pytest.approx(numeric, rel=2e-4)  # the table's edge at 90 degrees
    for kind in (2, 3):
        angles = (-90, -10, 25, 90)
        side = read_ies(write(tmp_path, text(angles, angles, kind=kind)))
        numeric = (side.at(towards(phi[:, None], np.degrees(c))) * np.sin(c)).sum()
        assert side.flux == pytest.approx(numeric * 2 * np.pi**2 / n**2, rel=2e-4)


def test_milliwatts_by_label_or_by_flag(tmp_path):
    plain, labelled = text(), text(labels=("[TEST] x", "[OTHER] intensities in mW/sr, 850 nm"))
    assert read_ies(write(tmp_path, plain)).unit == "cd"
    for content, unit in ((plain, "mW/sr"), (labelled, None)):
        profile = read_ies(write(tmp_path, content), unit=unit)
        assert profile.unit == "W/sr"
        assert profile.at([0, 0, 1]) == pytest.approx(0.1)
    assert read_ies(write(tmp_path, labelled), unit="cd").unit == "cd"


def test_tilt_is_taken_at_the_lamps_tilt(tmp_path):
    path = write(tmp_path, text(tilt="TILT=INCLUDE\n1\n3\n0 45 90\n1 0.8 0.6"))
    found = read_ies(path)
    assert found.at([0, 0, 1]) == pytest.approx(100)
    tilted = read_ies(path, tilt_deg=22.5)
    assert tilted.at([0, 0, 1]) == pytest.approx(90)


def test_labels_may_continue_and_commas_separate(tmp_path):
    content = text(labels=("[TEST] a", "[LUMINAIRE] one", "[MORE] two", "[OTHER] \xb0"))
    found = read_ies(write(tmp_path, content.replace("0.0 30.0", "0.0, 30.0,\n")))
    assert found.colatitude_deg.tolist() == list(VERTICAL)


@pytest.mark.parametrize(
    ("content", "line", "said"),
    [
        ("no photometry at all\n", 1, "TILT="),
        (text(first="IESNA:LM-63-1999"), 1, "edition"),
        (text(first="", head=(1, 1000, 1), ballast=(1, 0, 20)), 4, "multiply all .* by 0"),
        (text(tilt="TILT=lamp.tlt"), 3, "TILT=INCLUDE"),
        (text(head=("one", 1000, 1)), 4, "number of lamps.*'one'"),
        (text(head=(1, 1000, -1)), 4, "multiplier"),
        (text(kind=4), 4, "photometric type"),
        (text(units=3), 4, "units"),
        (text(ballast=(1, "nan", 20)), 5, "factor"),
        (text(vertical=(0, 60, 30)), 6, "vertical angles must ascend"),
        (text(vertical=(0, 60, 190)), 6, r"\[0, 180\]"),
        (text((0, 100)), 7, "horizontal angles of type C"),
        (text((10, 90)), 7, "horizontal angles of type C"),
        (text(values=[[1, 2, "x", 4]]), 8, "candela values.*'x'"),
        (text(values=[[1, 2, -3, 4]]), 8, "candela values"),
        (text(values=[[1, 2, 3]]), 8, "expected 4 candela values, but the file ends after 3"),
        (text(values=[[1, 2, 3, 4, 5]]), 8, "expected the end of the file, got '5'"),
    ],
)
def test_malformed_files_name_file_and_line(tmp_path, content, line, said):
    with pytest.raises(IesError, match=rf"lamp\.ies, line {line}: .*{said}"):
        read_ies(write(tmp_path, content))


def test_an_absent_file_is_named(tmp_path):
    with pytest.raises(IesError, match=r"none\.ies: cannot be read"):
        read_ies(tmp_path / "none.ies")


RIG = """
[[cameras]]
name = "c"
position = [0, -1, 0]
target = [0, 0, 0]
fov_deg = 20
width = 8
height = 8
[profiles.flood]
file = "lamp.ies"
unit = "relative"
[[lights]]
name = "key"
position = [0.0, -2.0, 0.0]
intensity = [8.0, 4.0, 2.0]
aim = [0, 1, 0]
roll_deg = 90
profile = "flood"
radius = 0.01
[[lights]]
name = "panel"
position = [0.0, 0.0, 2.0]
intensity = [1.0, 1.0, 1.0]
aim = [0, 0, -1]
size = [0.2, 0.1]
[dome]
lights = 3
radius = 1.2
intensity = [1.0, 1.0, 1.0]
profile = "flood"
"""


def test_a_rigs_lamps_have_profiles_and_aims(tmp_path):
    write(tmp_path, text((0, 90), values=[[100, 80, 40, 0], [100, 60, 20, 0]]))
    (tmp_path / "rig.toml").write_text(RIG)
    rig = Rig.load(tmp_path / "rig.toml")
    key, panel, *dome = rig.lights
    np.testing.assert_allclose(key.intensity_towards([0, 1, 0]), [8, 4, 2])
    # rolled clockwise by 90 degrees: what was to the lamp's right is below
    at_30 = [0, -2 + np.cos(np.pi / 6), -np.sin(np.pi / 6)]
    np.testing.assert_allclose(key.intensity_towards(at_30), 0.8 * key.intensity)
    at_30 = [np.sin(np.pi / 6), -2 + np.cos(np.pi / 6), 0]
    np.testing.assert_allclose(key.intensity_towards(at_30), 0.6 * key.intensity)
    np.testing.assert_allclose(panel.intensity_towards([[0, 1, 1], [0, 0, 3]])[:, 0], [0.5**0.5, 0])
    for lamp in dome:
        np.testing.assert_allclose(lamp.intensity_towards([0, 0, 0]), 1)
    (tmp_path / "rig.json").write_text(json.dumps(rig.to_dict()))
    (tmp_path / "lamp.ies").unlink()
    again = Rig.load(tmp_path / "rig.json")
    assert again.to_dict() == rig.to_dict()
    assert len(again.to_dict()["profiles"]) == 1
    points = np.random.default_rng(0).normal(size=(20, 3))
    for a, b in zip(rig.lights, again.lights, strict=True):
        np.testing.assert_array_equal(a.intensity_towards(points), b.intensity_towards(points))
    Q = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    d = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(
        key.moved(Q, d).intensity_towards(points), key.intensity_towards(points @ Q.T + d)
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('profile = "flood"\nradius', 'profile = "spot"\nradius', r"no \[profiles.spot\]"),
        ("aim = [0, 1, 0]", "", "needs an aim"),
        ("aim = [0, 1, 0]", "aim = [0, 0, 0]", "aim must be a direction"),
        ("radius = 0.01", "radius = -1", "radius must be 0 or more"),
        ("radius = 0.01", "size = [1, 1, 1]", "size must be 2"),
        ("radius = 0.01", "radios = 1", r"unknown fields \['radios'\]"),
        ('unit = "relative"', 'unit = "lumen"', "unit must be"),
        ('unit = "relative"', "tilt = 3", r"unknown fields \['tilt'\]"),
        ('file = "lamp.ies"', 'file = "gone.ies"', "gone.ies"),
    ],
)
def test_a_lamp_that_cannot_be_is_refused(tmp_path, old, new, said):
    write(tmp_path, text())
    (tmp_path / "rig.toml").write_text(RIG.replace(old, new, 1))
    with pytest.raises(RigError, match=rf"rig\.toml: .*{said}"):
        Rig.load(tmp_path / "rig.toml")
