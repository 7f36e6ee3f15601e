"""Pictures as users have them: formats, names, brackets, what is missing or broken."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from dng_writer import BLACK, BLUE, GREEN, RED, WHITE, write_dng

from reconstruction import Capture, CaptureWriter, import_folder, verify, write_exr
from reconstruction.arrays import Floats
from reconstruction.capture.contact_sheet import contact_sheet
from reconstruction.capture.import_folder import Import, ImportProblem, settings_of
from reconstruction.files.pictures import PictureError, Sensor, read_picture
from reconstruction.images.silhouettes import silhouette
from stage_service.cli import main

SIZE = 24  # pixels on a side
CAMERAS, LIGHTS = ("left", "right"), ("light_000", "light_001", "light_002")


def light_of(camera: int, light: int) -> Floats:
    """A smooth picture (H, W, 3), up to about 0.9."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    grey = 0.1 + 0.35 * x + 0.25 * y * (1 + light) / 3 + 0.1 * camera
    return np.asarray(grey[..., None] * np.array([1.0, 0.7, 0.5]), np.float32)


def srgb(light: Floats) -> Floats:
    """Values of linear light, IEC 61966-2-1."""
    power = 1.055 * np.clip(light, 1e-9, None) ** (1 / 2.4) - 0.055
    return np.asarray(np.where(light <= 0.0031308, 12.92 * light, power), np.float32)


def save(path: Path, value: Floats, kind: type) -> None:
    """`value (H, W, 3)` or `(H, W)`, 1 at white, as whole numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    white = np.iinfo(kind).max
    counts = np.round(np.clip(value, 0, 1) * white).astype(kind)
    assert cv2.imwrite(str(path), counts[..., ::-1] if counts.ndim == 3 else counts)


def save_as_shot(path: Path, value: Floats, seconds: float, iso: int = 100) -> None:
    """`value (H, W, 3)`, 1 at white, with the seconds of its exposure written into the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exr = path.suffix == ".exr"
    spec = oiio.ImageSpec(SIZE, SIZE, 3, oiio.FLOAT if exr else oiio.UINT8)
    spec.attribute("ExposureTime", seconds)
    spec.attribute("Exif:PhotographicSensitivity", iso)
    spec.attribute("CompressionQuality", 100)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(value if exr else np.round(255 * np.clip(value, 0, 1)).astype(np.uint8))
    out.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Cameras and lights, no pictures yet."""
    root = tmp_path / "elsewhere"
    root.mkdir()
    K = [[30, 0, 11.5], [0, 30, 11.5], [0, 0, 1]]
    pose = {"width": SIZE, "height": SIZE, "K": K, "R": np.eye(3).tolist()}
    cameras = [{"id": c, **pose, "t": [i, 0, 1]} for i, c in enumerate(CAMERAS)]
    lights = [
        {"id": name, "position": [0, i, -1], "intensity": [1, 1, 1]}
        for i, name in enumerate(LIGHTS)
    ]
    (root / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    (root / "lights.json").write_text(json.dumps({"lights": lights}))
    return root


def settings(folder: Path, text: str) -> None:
    (folder / "import.toml").write_text(text)


def everywhere(write: Callable[[str, int, Floats], Any]) -> None:
    for c, camera in enumerate(CAMERAS):
        for n in range(len(LIGHTS)):
            write(camera, n, light_of(c, n))


@pytest.mark.parametrize(
    ("name", "kind", "error"),
    [
        ("{}/{:03d}.png", np.uint16, 1e-5),
        ("{}/{:03d}.tif", np.uint16, 1e-5),
        ("{}/{:03d}.png", np.uint8, 5e-3),
        ("{}/{:03d}.ppm", np.uint16, 1e-5),
        ("{}/{:03d}.jpg", np.uint8, 4e-2),
    ],
)
def test_a_format_is_read_as_linear_light(folder, tmp_path, name, kind, error):
    """By pattern; 8 bits are sRGB and JPEG is warned of."""
    code = srgb if kind is np.uint8 else np.asarray
    everywhere(lambda c, n, x: save(folder / name.format(c, n), code(x), kind))
    settings(folder, f'pictures.olat = "{{camera}}/{{light}}{Path(name).suffix}"')
    capture = import_folder(folder, tmp_path / "out")
    assert verify(capture.path) == []
    for c, camera in enumerate(CAMERAS):
        for n, light in enumerate(LIGHTS):
            image, saturated = capture.light(light, camera)
            np.testing.assert_allclose(image, light_of(c, n), atol=error)
            assert not saturated.any()
    said = capture.plan["import"]
    assert said["relative"]
    assert any("JPEG" in note for note in said["notes"]) == name.endswith("jpg")


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_avif_of_any_depth_is_the_same_light(tmp_path, bits):
    kind, white = (np.uint8 if bits == 8 else np.uint16), 2**bits - 1
    light = light_of(0, 1)
    light[:4] = 2.0  # more than the file can say
    counts = np.round(np.clip(srgb(light), 0, 1) * white).astype(kind)[..., ::-1]
    how = [cv2.IMWRITE_AVIF_DEPTH, bits, cv2.IMWRITE_AVIF_QUALITY, 100]
    assert cv2.imwrite(str(tmp_path / "a.avif"), counts, how)
    found = read_picture(tmp_path / "a.avif", Sensor(), (SIZE, SIZE))
    np.testing.assert_allclose(found.light[6:], light[6:], atol=0.02)
    assert found.saturated[:2].all()
    assert not found.saturated[6:].any()


def test_floats_above_1_are_light_and_not_saturated(tmp_path):
    """A TIFF of floats, merged of exposures or rendered, was saturated wherever it was above .99;
    EXR of the same numbers was not."""
    light = 20 * light_of(0, 1)
    cv2.imwrite(str(tmp_path / "a.tif"), light[..., ::-1])
    write_exr(tmp_path / "a.exr", light)
    for name in ("a.tif", "a.exr"):
        found = read_picture(tmp_path / name, Sensor(), (SIZE, SIZE))
        np.testing.assert_allclose(found.light, light, rtol=1e-6)
        assert not found.saturated.any(), name
        assert found.full == np.inf
        full = read_picture(tmp_path / name, Sensor(white=10.0), (SIZE, SIZE))
        bright = light.max(axis=-1)
        assert full.saturated[bright > 10].all()
        assert not full.saturated[bright < 9.8].any()


def test_layered_exr_is_distinguished_from_a_broken_one(tmp_path):
    """Of two layers of colours none is the image; copying them anew is no help."""
    path, layer = tmp_path / "a.exr", np.ones((SIZE, SIZE), np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {f"{n}.{c}": layer for n in ("Combined", "Diffuse") for c in "RGB"}
    OpenEXR.File(header, channels).write(str(path))
    with pytest.raises(PictureError, match=r"got Combined\.B.*: write .* as RGB") as caught:
        read_picture(path, Sensor(), (SIZE, SIZE))
    assert "copy it again" not in str(caught.value)


def test_an_exr_of_grey_or_of_channels_of_several_types_is_read(tmp_path):
    path, light = tmp_path / "a.exr", light_of(0, 0)
    red, green, blue = (light[..., k].copy() for k in range(3))
    half = red.astype(np.float16)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for channels, expected in (
        ({"Y": green}, [green] * 3),
        ({"Y": green, "A": np.ones_like(green)}, [green] * 3),
        ({"R": half, "G": green, "B": blue}, [half, green, blue]),
        ({"R": red, "G": green, "B": blue, "A": half}, [red, green, blue]),
    ):
        OpenEXR.File(header, channels).write(str(path))
        found = read_picture(path, Sensor(), (SIZE, SIZE))
        np.testing.assert_array_equal(found.light, np.stack(expected, axis=-1))


def test_pictures_without_light_are_refused(folder, tmp_path):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"light_{n:03d}.png", 0 * x, np.uint8))
    with pytest.raises(ImportProblem, match="no pixel of any image is above black"):
        import_folder(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_camera_whose_folder_is_a_link_has_its_pictures(folder, tmp_path):
    """They lie on another disk; all its frames were missing. Links to what holds them end, and
    those beside a folder do not take its place."""
    disk = tmp_path / "disk"
    everywhere(lambda c, n, x: save(disk / c / f"light_{n:03d}.png", x, np.uint16))
    (folder / "images").mkdir()
    (disk / "left").rename(folder / "images/left")
    (folder / "images/right").symlink_to(disk / "right", target_is_directory=True)
    (disk / "right/back").symlink_to(folder, target_is_directory=True)
    (folder / "another").symlink_to(folder / "images", target_is_directory=True)
    observed = Import.of(folder)
    assert observed.missing == []
    assert observed.counts()["frames"] == len(CAMERAS) * len(LIGHTS)


HALF_TURN = np.frombuffer(
    b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x03\0\0\0\0\0\0\0", np.uint8
)
"""EXIF whose orientation is 3: a viewer shows the picture upside down."""


def test_exif_rotation_is_as_the_setting(tmp_path):
    """In a square image it may be meant or not: the user states it."""
    stored = np.zeros((SIZE, SIZE, 3), np.uint8)
    stored[4:10, 2:8] = 255
    for name in ("turned.avif", "turned.png", "turned.jpg"):
        kinds = [cv2.IMAGE_METADATA_EXIF]
        cv2.imwriteWithMetadata(str(tmp_path / name), stored, kinds, [HALF_TURN])
        for orientation, expected in (("stored", stored), ("turned", stored[::-1, ::-1])):
            sensor = Sensor(orientation=orientation)
            light = read_picture(tmp_path / name, sensor, (SIZE, SIZE)).light
            np.testing.assert_array_equal(light > 0.5, expected > 0, err_msg=name)
        with pytest.raises(PictureError, match=r'orientation 3 .*orientation = "stored"'):
            read_picture(tmp_path / name, Sensor(), (SIZE, SIZE))


def test_brackets_are_merged_and_saturation_is_kept(folder, tmp_path):
    """Three noisy exposures of 8 bits tell more than the best one; what all clip is saturated."""
    rng = np.random.default_rng(0)
    bright = 40 * light_of(0, 0)
    bright[2:4, 3:6] = 300  # above what 1/160 s holds
    seconds = {"1-10": 0.1, "1-40": 0.025, "1-160": 1 / 160}
    shots = {text: rng.poisson(bright * s * 1e4) / 1e4 for text, s in seconds.items()}
    for camera in CAMERAS:
        for n in range(len(LIGHTS)):
            for text, shot in shots.items():
                save(folder / f"{camera}/{n}_{text}.png", shot.astype(np.float32), np.uint8)
    settings(
        folder,
        'sensor.response = "linear"\npictures.olat = "{camera}/{light}_{exposure}.png"\n',
    )
    capture = import_folder(folder, tmp_path / "out")
    image, saturated = capture.light("light_001", "left")
    expected = np.zeros((SIZE, SIZE), bool)
    expected[2:4, 3:6] = True
    np.testing.assert_array_equal(saturated, expected)
    assert capture.of_kind("olat")[0].exposure == 0.1
    held = (bright.max(axis=-1) < 0.95 * 10) & ~expected  # by the longest exposure
    error = np.sqrt(np.mean((image - bright)[held] ** 2))
    longest = np.round(255 * shots["1-10"][held]) / 255 * 10
    assert error < 0.95 * np.sqrt(np.mean((longest - bright[held]) ** 2))
    rest = ~held & ~expected  # that only the shorter ones hold
    assert np.abs(image - bright)[rest].max() < 0.1 * bright[rest].max()


@pytest.mark.parametrize("suffix", ["jpg", "tif", "png", "exr"])
def test_seconds_that_the_files_say(folder, tmp_path, suffix):
    """Two exposures of a frame, told apart by what is written in the files alone."""

    def write(camera: str, n: int, x: Floats) -> None:
        for name, seconds in ("DSC_1", 1 / 125), ("DSC_2", 1 / 30):
            path = folder / camera / f"{n}_{name}.{suffix}"
            path.parent.mkdir(exist_ok=True)
            save_as_shot(path, x * seconds * 8, seconds)

    everywhere(write)
    settings(
        folder,
        f'exposure = "file"\nsensor.response = "linear"\n'
        f'pictures.olat = "{{camera}}/{{light}}_*.{suffix}"\n',
    )
    understood = Import.of(folder)
    assert understood.counts()["exposures_per_frame"] == {2: 6}
    assert not any("ISO" in note for note in understood.found.notes)
    capture = import_folder(folder, tmp_path / "out")
    assert capture.of_kind("olat")[0].exposure == pytest.approx(
        1 / 30, rel=2e-5
    )  # EXIF's rationals
    image, _ = capture.light("light_001", "left")
    count = 30 / 255  # of the longer exposure
    assert np.abs(image - 8 * light_of(0, 1)).max() < (3 if suffix == "jpg" else 1) * count


def test_shots_of_another_sensitivity_give_a_warning(folder):
    everywhere(lambda c, n, x: save_as_shot(folder / f"images/{c}/{n}.png", x, 0.1, 100 * (n + 1)))
    settings(folder, 'exposure = "file"\n')
    (note,) = [n for n in Import.of(folder).found.notes if "ISO" in n]
    assert "ISO 100 f/0, ISO 200 f/0, ISO 300 f/0" in note


def test_a_picture_that_does_not_say_its_seconds(folder):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint8))
    settings(folder, 'exposure = "file"\n')
    with pytest.raises(ImportProblem, match=r"0\.png: no exposure time in the file: give"):
        Import.of(folder)


def test_a_mosaic_and_its_black_level(folder, tmp_path):
    """A 12-bit Bayer mosaic in 16 bits, 256 counts at black."""
    first = {"R": 0, "G": 1, "B": 2}

    def write(camera: str, n: int, x: Floats) -> None:
        mosaic = np.zeros((SIZE, SIZE), np.uint16)
        for i, colour in enumerate("GBRG"):
            at = np.s_[i // 2 :: 2, i % 2 :: 2]
            mosaic[at] = np.round(256 + (4095 - 256) * x[at][..., first[colour]])
        path = folder / camera / f"{n}.tif"
        path.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), mosaic)

    everywhere(write)
    settings(
        folder,
        'pictures.olat = "{camera}/{light}.tif"\n'
        "[sensor]\nbayer = 'GBRG'\nblack = 256\nwhite = 4095\n",
    )
    capture = import_folder(folder, tmp_path / "out")
    image, _ = capture.light("light_002", "right")
    inner = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(image[inner], light_of(1, 2)[inner], atol=0.01)


def test_missing_frames_are_values(folder, tmp_path):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    (folder / "images/left/1.png").unlink()
    for camera in CAMERAS:
        (folder / "images" / camera / "2.png").unlink()
    capture = import_folder(folder, tmp_path / "out")
    assert capture.olat_lights() == ["light_000", "light_001"]
    assert not capture.has_light("light_001", "left")
    assert capture.has_light("light_001", "right")
    assert any("light_002" in note for note in capture.plan["import"]["notes"])
    assert not any("all frames are missing" in note for note in capture.plan["import"]["notes"])
    for picture in (folder / "images" / "right").iterdir():
        picture.unlink()
    capture = import_folder(folder, tmp_path / "again")
    said = "right: no images, all frames are missing"
    assert said in capture.plan["import"]["notes"]


def test_clean_plate_separates_the_subject_and_is_subtracted(folder, tmp_path):
    """A wall at 3 % and a subject before it, whose shadow falls on the wall under one light."""
    rng = np.random.default_rng(0)
    inside = np.zeros((SIZE, SIZE), bool)
    inside[6:18, 8:16] = True
    for camera in CAMERAS:
        for n in range(len(LIGHTS)):
            wall = np.full((SIZE, SIZE, 3), 0.03, np.float32)
            shot = wall.copy()
            if n == 0:
                shot[2:5] = 0.003  # the shadow
            shot[inside] = 0.01 if n == 1 else 0.6
            for name, image in (("plate", wall), ("olat", shot)):
                noisy = image + rng.normal(0, 2e-4, image.shape)
                save(folder / name / camera / f"{n}.png", noisy.astype(np.float32), np.uint16)
    olat = 'pictures.olat = "olat/{camera}/{light}.png"\n'
    settings(folder, olat)
    alone = silhouette(import_folder(folder, tmp_path / "walled"), "left")
    np.testing.assert_array_equal(alone, inside)  # by what changes with the light
    settings(folder, olat + 'pictures.clean_plate = "plate/{camera}/{light}.png"')
    capture = import_folder(folder, tmp_path / "out")
    np.testing.assert_array_equal(silhouette(capture, "left"), inside)
    image, _ = capture.light("light_002", "left")
    assert abs(image[~inside].mean()) < 1e-3
    np.testing.assert_allclose(image[inside], 0.6, atol=2e-3)


def test_clean_plates_that_match_no_frame_give_a_warning(folder, tmp_path):
    """Plates without a light, where no frame has all lights on; one camera's are as they should."""
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    save(folder / "plate/right.png", light_of(1, 0), np.uint16)
    settings(folder, 'pictures.clean_plate = "plate/{camera}.png"')
    (note,) = [n for n in Import.of(folder).found.notes if "clean" in n]
    assert note.startswith("right: no frame has the light of a clean plate")
    capture = import_folder(folder, tmp_path / "out")
    assert note in capture.plan["import"]["notes"]
    assert not list(capture.path.glob("subjects/*"))
    plates = folder / "plate"
    (plates / "right").mkdir()
    (plates / "right.png").rename(plates / "right" / "all.png")
    save(plates / "left" / "1.png", 0 * light_of(0, 0), np.uint16)
    save(plates / "right" / "1.png", 0 * light_of(0, 0), np.uint16)
    (folder / "images/right/1.png").unlink()
    settings(folder, 'pictures.clean_plate = "plate/{camera}/{light}.png"')
    capture = import_folder(folder, tmp_path / "other")
    (note,) = [n for n in capture.plan["import"]["notes"] if "clean" in n]
    assert note.startswith("right: ")
    assert [p.name for p in capture.path.glob("subjects/*")] == ["left.png"]


def test_clean_plates_that_show_the_subject_are_refused(folder, tmp_path):
    for name in ("plate", "olat"):
        everywhere(lambda c, n, x, at=name: save(folder / at / c / f"{n}.png", x, np.uint16))
    text = 'pictures.olat = "olat/{camera}/{light}.png"\n'
    settings(folder, text + 'pictures.clean_plate = "plate/{camera}/{light}.png"')
    with pytest.raises(ImportProblem, match="no pixel of a frame differs from its clean plate"):
        import_folder(folder, tmp_path / "out")


@pytest.mark.parametrize(
    ("requested", "says"),
    [
        (["--light-distance", "2"], "--light-distance needs --lights"),
        (["--take", "ID20001"], "--take needs --preset faceolat"),
        (
            ["--preset", "humanolat", "--pictures", "x"],
            "--pictures cannot be combined with --preset",
        ),
    ],
)
def test_options_without_effect_are_refused(folder, tmp_path, capsys, requested, says):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    assert main(["import", str(folder), "--out", str(tmp_path / "out"), *requested]) != 0
    assert says in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_import_that_is_stopped_leaves_nothing(
    folder, tmp_path, monkeypatch, capsys, number, code
):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    command = ["import", str(folder), "--out", str(tmp_path / "out")]
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}[number]
    write, before = CaptureWriter.write_frame, signal.signal(number, usual)
    with monkeypatch.context() as stopped:
        written = []

        def second_stops(*args, **more):
            write(*args, **more)
            written.append(args)
            if len(written) == 2:
                signal.raise_signal(number)

        stopped.setattr(CaptureWriter, "write_frame", second_stops)
        assert main(command) == code
    assert "the unfinished capture was removed" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert signal.signal(number, before) is usual
    assert main(command) == 0


def test_a_dry_run_draws_beside_a_folder_that_is_not_there(folder, tmp_path, monkeypatch, capsys):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    assert main(["import", str(folder), "--out", str(tmp_path / "new/out"), "--dry-run"]) == 0
    assert (tmp_path / "new" / "out-contact-sheet.png").is_file()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert main(["import", str(folder), "--out", ".", "--dry-run"]) == 0
    assert (tmp_path / "here-contact-sheet.png").is_file()
    (tmp_path / "here" / "notes.txt").touch()
    assert main(["import", str(folder), "--out", ".", "--dry-run"]) == 3
    assert "needs a new or empty folder" in capsys.readouterr().err


def test_a_flat_field_evens_the_lens(folder, tmp_path):
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    falls = (1 - 0.4 * (x**2 + y**2) / (x**2 + y**2).max())[..., None].astype(np.float32)
    everywhere(
        lambda c, n, image: save(folder / "images" / c / f"{n}.png", image * falls, np.uint16)
    )
    for camera in CAMERAS:
        save(folder / f"flat_{camera}.png", 0.8 * falls * np.ones(3, np.float32), np.uint16)
    settings(folder, 'pictures.flat = "flat_{camera}.png"')
    capture = import_folder(folder, tmp_path / "out")
    expected = light_of(0, 1) * falls.mean()
    np.testing.assert_allclose(capture.light("light_001", "left")[0], expected, rtol=2e-3)


def test_a_flat_field_that_saturates_is_refused(folder, tmp_path):
    """It would say that the lens darkens nothing."""
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    falls = np.linspace(0.5, 1.6, SIZE)[:, None, None] * np.ones((1, SIZE, 3), np.float32)
    for camera in CAMERAS:
        save(folder / f"flat_{camera}.png", falls, np.uint16)
    settings(folder, 'pictures.flat = "flat_{camera}.png"')
    with pytest.raises(ImportProblem, match=r"flat_.*\.png: 5\d% of the flat field is saturated"):
        import_folder(folder, tmp_path / "out")


def cut_off(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def is_smaller(path: Path) -> None:
    save(path, np.zeros((SIZE, SIZE // 2, 3), np.float32), np.uint16)


def is_text(path: Path) -> None:
    path.write_text("no picture")


@pytest.mark.parametrize("suffix", ["png", "tif", "exr", "jpg", "dng"])
@pytest.mark.parametrize(
    ("break_it", "says"),
    [
        (cut_off, "copy it again"),
        (is_text, "copy it again"),
        (is_smaller, "12x24 pixels, expected 24x24"),
    ],
)
def test_a_broken_picture_says_what_to_do(folder, tmp_path, suffix, break_it, says):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    old, new = folder / "images/right/1.png", folder / f"images/right/1.{suffix}"
    if suffix == "dng":
        if break_it is is_smaller:
            pytest.skip("LibRaw opens none that small")
        old.unlink()
        write_dng(new, np.full((SIZE, SIZE), 1000, np.uint16))
    else:
        kind = np.uint8 if suffix == "jpg" else np.uint16
        old.unlink()
        if suffix == "exr":
            shape = (SIZE, SIZE // 2, 3) if break_it is is_smaller else (SIZE, SIZE, 3)
            write_exr(new, np.zeros(shape, np.float32))
        else:
            save(new, light_of(0, 0), kind)
    if not (suffix == "exr" and break_it is is_smaller):
        break_it(new)
    with pytest.raises(ImportProblem, match=says) as problem:
        import_folder(folder, tmp_path / "out")
    assert f"1.{suffix}" in str(problem.value)
    assert not (tmp_path / "out").exists()


def test_a_raw_file_is_light_between_its_black_and_white(tmp_path):
    values = np.empty((24, 32), np.uint16)
    light = {(0, 0): 0.25, (0, 1): 0.5, (1, 0): 0.5, (1, 1): 0.75}  # red, green, green, blue
    for (y, x), share in light.items():
        values[y::2, x::2] = round(BLACK + share * (WHITE - BLACK))
    write_dng(tmp_path / "flat.dng", values)
    picture = read_picture(tmp_path / "flat.dng", Sensor(), (32, 24))
    np.testing.assert_allclose(
        picture.light, np.broadcast_to([0.25, 0.5, 0.75], (24, 32, 3)), atol=1e-4
    )
    assert not picture.saturated.any()


def test_a_colour_matrix_of_raw_that_is_not_applied_is_named(folder):
    grey = np.full((SIZE, SIZE), 3000, np.uint16)
    for camera in CAMERAS:
        (folder / "images" / camera).mkdir(parents=True)
    everywhere(lambda c, n, x: write_dng(folder / f"images/{c}/{n}.dng", grey))
    for text, noted in (("", 1), ("sensor.matrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n", 0)):
        settings(folder, text)
        notes = [n for n in Import.of(folder).found.notes if "ColorMatrix is not applied" in n]
        assert len(notes) == noted


@pytest.mark.parametrize(
    ("sensor", "says"),
    [
        ({"mosaic": (RED, GREEN, RED, BLUE)}, "not a Bayer mosaic: develop it"),
        ({"black": WHITE}, "black 65535 must be below white 65535"),
    ],
)
def test_a_raw_file_of_a_sensor_that_is_not_known_is_refused(tmp_path, sensor, says):
    write_dng(tmp_path / "odd.dng", np.full((24, 32), 1000, np.uint16), **sensor)
    with pytest.raises(PictureError, match=says):
        read_picture(tmp_path / "odd.dng", Sensor(), (32, 24))


def test_an_exr_of_counts_needs_white_as_well_as_black(tmp_path):
    """Its white is 1 where nothing says more: above a black of 64 light was negative."""
    counts = np.full((3, 4, 3), 314, np.float32)
    write_exr(tmp_path / "counts.exr", counts)
    with pytest.raises(PictureError, match=r"counts\.exr: black 64 must be below white 1: give"):
        read_picture(tmp_path / "counts.exr", Sensor(black=64), (4, 3))
    picture = read_picture(tmp_path / "counts.exr", Sensor(black=64, white=1064), (4, 3))
    np.testing.assert_allclose(picture.light, 0.25, rtol=1e-6)


def test_numbers_of_each_camera_are_one_step_of_a_light(folder, tmp_path):
    """A counter of the camera's own says nothing of a light that is shot once."""
    numbers = iter(range(900))
    everywhere(
        lambda c, n, x: save(folder / "images" / c / f"{next(numbers)}_{n}.png", x, np.uint16)
    )
    settings(folder, "[pictures]\nolat = 'images/{camera}/{number}_{light}.png'\n")
    capture = import_folder(folder, tmp_path / "out")
    assert [s.light for s in capture.steps] == list(LIGHTS)
    assert all(capture.has(s, c) for s in capture.steps for c in CAMERAS)
    # where one is shot twice the number tells which is which
    save(folder / "images/left/1000_0.png", light_of(0, 0), np.uint16)
    save(folder / "images/right/1000_0.png", light_of(1, 0), np.uint16)
    again = import_folder(folder, tmp_path / "again")
    assert [s.light for s in again.steps if again.has(s, "left")] == [LIGHTS[0], *LIGHTS]


def test_two_files_for_one_frame(folder, tmp_path):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    save(folder / "images/left/1.tif", light_of(0, 0), np.uint16)
    with pytest.raises(ImportProblem, match=r"1\.tif and .*1\.png match the same frame of left"):
        import_folder(folder, tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("exposure = 0", "exposure.*Input should be greater than 0"),
        ("expsure = 1", "expsure: Unexpected"),
        ("exposure = ", "not TOML"),
        ('pictures.olat = "{cam}/{light}.png"', "unknown fields"),
        ('pictures.olat = "{camera}.png"', "the fields light are required"),
        ('pictures.olat = "photos/{camera}_{light}.png"', "give --pictures a pattern"),
    ],
)
def test_wrong_settings(folder, tmp_path, text, says):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    settings(folder, text)
    with pytest.raises(ImportProblem, match=says):
        import_folder(folder, tmp_path / "out")


def test_interpreted_settings_are_reported_and_drawn(folder, tmp_path):
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n + 1:04d}.png", x, np.uint16))
    save(folder / "images/notes/x.png", light_of(0, 0), np.uint16)
    settings(folder, "first_light = 1")
    understood = Import.of(folder, None, settings_of(folder))
    assert understood.counts()["frames"] == 6
    said = understood.summary()
    assert "left: 3 frames of 24x24, images/left/0001.png, …" in said
    assert {"cameras: 2", "steps: 3 olat", "units: relative"} <= set(said)
    assert any("images/notes/x.png" in note for note in understood.found.notes)
    contact_sheet(understood, tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape[0] == 2 * 160
    assert not (tmp_path / "out").exists()


@pytest.fixture
def beamed(folder):
    """The folder with pictures of single lights, and a projector."""
    everywhere(lambda c, n, x: save(folder / "images" / c / f"{n}.png", x, np.uint16))
    pose = {"K": [[30, 0, 11.5], [0, 30, 11.5], [0, 0, 1]], "R": np.eye(3).tolist()}
    beam = {"name": "proj_0", "width": 8, "height": 4, **pose, "t": [0, 0, 1]}
    (folder / "projectors.json").write_text(json.dumps({"projectors": [beam]}))
    return folder


def test_rows_that_nothing_places_between_tracking_frames(beamed):
    """All would come before the first, and no motion would be taken off them."""
    tracking = 'pictures.tracking = "{camera}/track_{number}.png"\n'
    rows = 'pictures.scanline = "{camera}/{projector}_{row}.png"\n'
    for camera in CAMERAS:
        for name in ("track_1", "proj_0_2"):
            save(beamed / camera / f"{name}.png", light_of(0, 0), np.uint16)
    settings(beamed, tracking + rows)
    assert Import.of(beamed).counts()["steps"] == {"olat": 3, "tracking": 1, "scanline": 1}
    for camera in CAMERAS:
        save(beamed / camera / "track_4.png", light_of(0, 0), np.uint16)
    with pytest.raises(ImportProblem, match=r"scanline.*without {number} the order"):
        Import.of(beamed)
    settings(beamed, rows)
    assert Import.of(beamed).counts()["steps"] == {"olat": 3, "scanline": 1}
    settings(beamed, tracking)
    assert Import.of(beamed).counts()["steps"] == {"olat": 3, "tracking": 2}


def test_the_documented_example_places_rows_between_tracking_frames(beamed):
    text = (Path(__file__).parents[3] / "docs" / "how-to" / "import.md").read_text()
    said = dict(re.findall(r"^(tracking|scanline) = (.*)$", text, re.MULTILINE))
    for camera in CAMERAS:
        for name in ("track_00001", "proj_0_00002_2", "proj_0_00003_3", "track_00004"):
            save(beamed / camera / f"{name}.png", light_of(0, 0), np.uint16)
    settings(beamed, "".join(f"pictures.{role} = {name}\n" for role, name in said.items()))
    kinds = [s.kind for s in Import.of(beamed).found.steps]
    assert kinds[3:] == ["tracking", "scanline", "scanline", "tracking"]


def test_steps_of_all_kinds(beamed, tmp_path):
    folder = beamed
    for camera in CAMERAS:
        for name in ("dark", "full", "track_00001", "track_00004", "row_00002_2", "row_00003_3"):
            save(folder / camera / f"{name}.png", light_of(0, 0), np.uint16)
    settings(
        folder,
        '[pictures]\ndark = "{camera}/dark.png"\nall_on = "{camera}/full.png"\n'
        'tracking = "{camera}/track_{number}.png"\n'
        'scanline = "{camera}/row_{number}_{row}.png"\n',
    )
    capture: Capture = import_folder(folder, tmp_path / "out")
    kinds = [(s.kind, s.row) for s in capture.steps]
    assert kinds == [
        ("dark", None), ("all_on", None), *[("olat", None)] * 3,
        ("tracking", None), ("scanline", 2), ("scanline", 3), ("tracking", None),
    ]  # fmt: skip
    assert capture.of_kind("scanline")[0].projector == "proj_0"


def test_lights_of_a_file_beside_cameras_json(folder: Path, tmp_path: Path) -> None:
    """By --lights: LEDs in millimetres with axes, instead of lights.json."""
    everywhere(lambda c, n, x: save(folder / f"images/{c}/{n:03d}.png", x, np.uint16))
    cameras = json.loads((folder / "cameras.json").read_text())["cameras"]
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras[:1]}))
    rows = [f"{i},0,{100 * i},-1000,0,0,1" for i in range(len(LIGHTS))]
    table = folder / "leds.csv"
    table.write_text("\n".join(["id,x_mm,y_mm,z_mm,aim_x,aim_y,aim_z", *rows]) + "\n")
    arguments = ["--lights", str(table), "--out", str(tmp_path / "out")]
    assert main(["import", str(folder), *arguments]) == 0
    light = Capture(tmp_path / "out").rig.lights[2]
    np.testing.assert_allclose(light.position, [0, 0.2, -1])
    aside = light.intensity_towards([1, 0.2, 0])  # at 45 degrees
    np.testing.assert_allclose(aside / light.intensity, np.sqrt(0.5), rtol=1e-4)
