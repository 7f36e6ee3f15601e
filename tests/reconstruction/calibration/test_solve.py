"""From captures to a rig file, through the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from reconstruction import Capture, Rig
from reconstruction.arrays import Bools, Floats
from reconstruction.calibration.boards import Board, CalibrationError
from reconstruction.calibration.rig_comparison import compare_rigs
from reconstruction.calibration.solve import TargetCaptures, Targets, calibrate
from stage_service.cli import main
from stage_service.config import load_rig_file


def test_captures_become_a_rig_file_that_is_near_the_truth(
    tmp_path: Path,
    true_rig: Rig,
    board_captures: list[Capture],
    mirror_captures: list[Capture],
    diffuse_captures: list[Capture],
    capsys: pytest.CaptureFixture[str],
) -> None:
    truth, out = tmp_path / "truth.json", tmp_path / "new" / "found.json"
    truth.write_text(json.dumps(true_rig.to_dict()))
    command = ["calibrate", "rig", *[str(c.path) for c in board_captures], "--out", str(out)]
    command += ["--mirror", *[str(c.path) for c in mirror_captures]]
    command += ["--diffuse", *[str(c.path) for c in diffuse_captures], "--diffuse-radius-mm", "60"]
    command += ["--paper-albedo", "0.8", "--truth", str(truth), "--json"]
    assert main(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert load_rig_file(out).rig.name == "nominal"
    errors = said["errors"]
    for name, camera in errors["cameras"].items():
        assert camera["reprojection_px"][0] < 0.3, name
        assert camera["centre_mm"] < 2.0, name
    assert errors["projectors"]["beam"]["plane_mm"] < 1.0
    for name, light in errors["lights"].items():
        assert light["position"] < 0.01, name
        assert light["intensity"] < 0.02, name
    assert said["warnings"] == []
    report = json.loads(out.with_suffix(".report.json").read_text())
    assert [s["name"] for s in report["stages"]] == ["cameras", "projectors", "lights"]
    assert "rows do not determine" in said["stages"]["projectors"]["undetermined"]["beam"]
    assert said["stages"]["lights"]["undetermined"] == {}


@pytest.mark.slow
def test_wrong_square_length_gives_a_warning(
    nominal_rig: Rig, board_captures: list[Capture]
) -> None:
    """Squares of 27 mm that are taken for 30 mm make every length a ninth too large."""
    rig = replace(nominal_rig, lights=(), projectors=())
    for square in (0.027, 0.03, 0.024):
        board = Board(square=square, marker=square * 21 / 27)
        _, report = calibrate(rig, TargetCaptures(board_captures), Targets(board))
        said = report["cameras"].warnings
        assert len(said) == (square != 0.027)
        for text in said:
            share = float(text.partition(" stand ")[2].partition("%")[0]) / 100
            assert share == pytest.approx(1 / 9, abs=0.025)  # nominal places are 1 cm off
            assert ("further apart" if square > 0.027 else "closer together") in text
            assert f"a square of the board measures {1e3 * square:g} mm?" in text


def test_cameras_with_each_others_names_are_warned_of(
    nominal_rig: Rig, board_captures: list[Capture]
) -> None:
    first, second, third = nominal_rig.cameras
    mixed = (replace(third, name="cam_0"), second, replace(first, name="cam_2"))
    rig = Rig("mixed", mixed, ())
    _, report = calibrate(rig, TargetCaptures(board_captures))
    (said,) = report["cameras"].warnings
    assert "cam_0" in said
    assert "cam_2" in said
    assert "check for exchanged names" in said


def test_a_nominal_rig_of_other_pictures_is_refused(
    nominal_rig: Rig, board_captures: list[Capture]
) -> None:
    """The pictures have 288 × 240 pixels; a lens of theirs is none of a picture half as wide."""
    halved = replace(nominal_rig, cameras=tuple(c.reduced(2) for c in nominal_rig.cameras))
    with pytest.raises(CalibrationError, match=r"cam_0 have 288 × 240 pixels, expected 144 × 120"):
        calibrate(halved, TargetCaptures(board_captures))


class Glaring(Capture):
    """A camera sees something that shines more than the mirror, under whatever lamp."""

    def light(self, light: str, camera: str) -> tuple[Floats, Bools]:
        image, saturated = super().light(light, camera)
        if camera == "cam_1":
            image = image.copy()
            image[20:24, 20:24] = 10 * image.max()
        return image, saturated


@pytest.mark.slow
def test_a_highlight_beside_the_mirror_gives_a_warning(
    nominal_rig: Rig, board_captures: list[Capture], mirror_captures: list[Capture]
) -> None:
    """Without it the highlights are met to under half a pixel."""
    rig = replace(nominal_rig, projectors=())
    for kind, warned in ((Capture, False), (Glaring, True)):
        mirrors = [kind(c.path) for c in mirror_captures]
        _, report = calibrate(rig, TargetCaptures(board_captures, mirrors))
        stage = report["lights"]
        assert (stage.figures["highlights_rms_px"] > 10) == warned
        said = [w for w in stage.warnings if "no lamp is in view" in w]
        assert len(said) == warned
        assert all("its radius is 50 mm" in w for w in said)


def test_a_part_of_a_rig_in_any_order_is_compared_by_name(true_rig: Rig) -> None:
    part = Rig("part", true_rig.cameras[:0:-1], true_rig.lights[2:], ())
    errors = compare_rigs(part, true_rig)
    assert set(errors["cameras"]) == {"cam_1", "cam_2"}
    assert max(c["centre_mm"] for c in errors["cameras"].values()) < 1e-6
    assert max(x["position"] for x in errors["lights"].values()) < 1e-9
    with pytest.raises(KeyError, match="no camera 'cam_0' in this rig"):
        compare_rigs(true_rig, part)


def test_a_light_of_another_colour_is_off_by_its_channels(true_rig: Rig) -> None:
    """Red a fifth too bright, blue as much too dim: to the mean it is as bright as the true one."""
    first, *others = true_rig.lights
    tinted = replace(first, intensity=[9.6, 9.0, 5.4])  # of 8, 9, 7
    errors = compare_rigs(replace(true_rig, lights=(tinted, *others)), true_rig)["lights"]
    assert errors.pop(first.name)["intensity"] == pytest.approx(1.6 / 9)
    assert max(x["intensity"] for x in errors.values()) == 0


def test_device_missing_from_the_truth_is_reported_before_the_work(
    tmp_path: Path,
    true_rig: Rig,
    board_captures: list[Capture],
    capsys: pytest.CaptureFixture[str],
) -> None:
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps(Rig("part", true_rig.cameras[1:], (), ()).to_dict()))
    command = ["calibrate", "rig", str(board_captures[0].path), "--out", str(tmp_path / "r.json")]
    assert main([*command, "--truth", str(truth), "--json"]) == 3
    assert f"--truth {truth}: no camera 'cam_0'" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"paper": 80.0}, "paper: expected an albedo above 0 and at most 1, got 80"),
        ({"paper": 0.0}, "paper: expected an albedo"),
        ({"diffuse_albedo": float("nan")}, "diffuse sphere: expected an albedo"),
        ({"mirror_radius": -0.05}, "mirror sphere: expected a radius"),
        ({"diffuse_radius": float("inf")}, "diffuse sphere: expected a radius"),
    ],
)
def test_impossible_target_sizes_are_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        Targets(**wrong)  # type: ignore[arg-type]


def test_devices_in_no_capture_stay_nominal_and_are_listed(
    nominal_rig: Rig, board_captures: list[Capture]
) -> None:
    rig, report = calibrate(
        nominal_rig, TargetCaptures(board_captures[3:] + board_captures[3:4]), keep_lens=True
    )
    assert rig.lights == nominal_rig.lights
    assert set(report["lights"].figures["undetermined"]) == {x.name for x in nominal_rig.lights}
    assert rig.projectors == nominal_rig.projectors
    assert "0 points" in report["projectors"].figures["undetermined"]["beam"]


def test_a_capture_without_the_board_is_an_error(
    nominal_rig: Rig, diffuse_captures: list[Capture]
) -> None:
    with pytest.raises(CalibrationError, match="visible in 0 captures"):
        calibrate(nominal_rig, TargetCaptures(diffuse_captures))


def test_the_board_can_be_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "board", str(tmp_path / "board.png"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["width_mm"] == pytest.approx(243)
    assert (tmp_path / "board.png").stat().st_size > 1000
