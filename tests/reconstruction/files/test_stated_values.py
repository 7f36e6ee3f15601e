"""What a file says of its place, scale and colour becomes light, or one sentence."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import stated_files as files
from PIL import ImageCms
from stated_files import LIGHT, H, W

from appearance.render.environment_maps import load_environment
from reconstruction.files.masks import decode_mask
from reconstruction.files.pictures import PictureError, Sensor, picture_size, read_picture

COUNTS = np.rint(LIGHT * 65535).astype(np.uint16)
ACES_CG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
P3_D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
TO_709 = {
    ACES_CG: [[1.7051, -0.6218, -0.0833], [-0.1303, 1.1408, -0.0105], [-0.0240, -0.1290, 1.1530]],
    REC_2020: [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    P3_D65: [[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]],
}
"""Published matrices: ACES (CTL, Bradford), ITU-R BT.2087, Apple's Display P3."""


def read(path: Path, size: tuple[int, int] = (W, H), **sensor: Any) -> Any:
    return read_picture(path, Sensor(**sensor), size, 1.0)


def linear(values: Any) -> Any:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((0, 0), (W - 1, H - 1)),
        ((8, 6), (19, 14)),  # crop
        ((-4, -3), (W + 2, H + 5)),  # overscan
        ((5, 0), (W + 4, H - 1)),  # shifted
        ((-7, 3), (2, 3)),  # one line, partly outside
        ((W - 1, H - 1), (W + 3, H + 3)),  # one pixel
    ],
)
@pytest.mark.parametrize("origin", [(0, 0), (-10, 100)])
@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_exr_pixels_lie_in_the_display_window(tmp_path, low, high, origin, kind):
    w, h = high[0] - low[0] + 1, high[1] - low[1] + 1
    data = np.random.default_rng(0).random((h, w, 3)).astype(kind)
    expected = np.zeros((H, W, 3), np.float32)
    for y in range(h):
        for x in range(w):
            if 0 <= y + low[1] < H and 0 <= x + low[0] < W:
                expected[y + low[1], x + low[0]] = data[y, x]
    at = np.array(origin)
    window = {"dataWindow": (tuple(at + low), tuple(at + high))}
    window["displayWindow"] = (tuple(at), (at[0] + W - 1, at[1] + H - 1))
    files.exr(tmp_path / "a.exr", data, **window)
    assert picture_size(tmp_path / "a.exr") == (W, H)
    np.testing.assert_array_equal(read(tmp_path / "a.exr").light, expected)
    np.testing.assert_array_equal(load_environment(tmp_path / "a.exr"), expected)


def exr_variants() -> dict[str, Any]:
    grey = np.full((H, W), 0.5, np.float32)
    layer = {f"beauty.{c}": np.ascontiguousarray(LIGHT[..., k]) for k, c in enumerate("RGB")}
    blender = {n.replace("beauty", "ViewLayer.Combined"): v for n, v in layer.items()}
    vectors = {f"N.{c}": grey for c in "XYZ"}
    return {
        "depth first": {"depth": {"Z": grey}, "rgba": LIGHT},
        "layer in part 2": {"N": vectors, "b": layer},
        "beside a layer": {"rgba": LIGHT, "d": {f"diffuse.{c}": grey for c in "RGB"}},
        "blender": {"one": {**blender, "ViewLayer.Depth.Z": grey, "ViewLayer.Combined.A": grey}},
        "vectors and alpha": {"one": {**layer, **vectors, "A": grey}},
    }


@pytest.mark.parametrize("name", exr_variants())
def test_exr_parts_and_layers(tmp_path, name):
    files.exr_parts(tmp_path / "a.exr", **exr_variants()[name])
    np.testing.assert_array_equal(read(tmp_path / "a.exr").light, LIGHT)


def exr_deep(path: Path) -> None:
    deep = np.empty((4, 4), object)
    for place in np.ndindex(4, 4):
        deep[place] = np.ones(2, np.float32)
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, dict.fromkeys("RGB", deep)).write(str(path))


GREY = np.full((H, W), 0.5, np.float32)
SPOILT = LIGHT.copy()
SPOILT[2, 3] = np.nan


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (lambda p: files.exr_parts(p, N=LIGHT, rgba=LIGHT), r"part 'N': B, G, R; part 'rgba'"),
        (lambda p: files.exr(p, {"Y": GREY, "RY": GREY, "BY": GREY}), "got BY, RY, Y"),
        (lambda p: files.exr(p, {"a.Y": GREY, "b.Y": GREY}), r"got a\.Y, b\.Y"),
        (exr_deep, "deepscanline: flatten"),
        (lambda p: files.exr(p, LIGHT, dataWindow=((90, 0), (89 + W, H - 1)),
                             displayWindow=((0, 0), (W - 1, H - 1))), "outside displayWindow"),
        (lambda p: files.exr(p, LIGHT, displayWindow=((0, 0), (70000, 1))),
         "70001x2 pixels: at most"),
        (lambda p: files.exr(p, LIGHT, whiteLuminance=100.0), "whiteLuminance 100 cd"),
        (lambda p: files.exr(p, LIGHT, adoptedNeutral=(0.44, 0.41)), "adoptedNeutral 0.44 0.41"),
        (lambda p: files.exr(p, LIGHT, pixelAspectRatio=2.0), "pixelAspectRatio 2,.*fy / fx"),
        (lambda p: files.exr(p, LIGHT, envmap=OpenEXR.Envmap.ENVMAP_CUBE), "envmap cube"),
        (lambda p: files.exr(p, LIGHT, colorInteropID="srgb_rec709_scene"), "srgb_rec709_scene"),
        (lambda p: files.exr(p, LIGHT, colorInteropID="lin_ap1_scene"), "lin_ap1_scene"),
        (lambda p: files.exr(p, LIGHT, chromaticities=(0.3,) * 8), "chromaticities .* span no"),
        (lambda p: files.exr(p, SPOILT), "3 values are not finite.*row 2, column 3: nan"),
    ],
)  # fmt: skip
def test_exr_that_is_not_light_is_refused(tmp_path, write, says):
    write(tmp_path / "a.exr")
    with pytest.raises(PictureError, match=rf"a\.exr: .*{says}") as problem:
        read(tmp_path / "a.exr", picture_size(tmp_path / "a.exr"))
    assert "\n" not in str(problem.value)


@pytest.mark.parametrize("primaries", TO_709)
def test_chromaticities_become_rec709(tmp_path, primaries):
    expected = LIGHT @ np.array(TO_709[primaries]).T
    files.exr(tmp_path / "a.exr", LIGHT, chromaticities=primaries, adoptedNeutral=primaries[6:])
    np.testing.assert_allclose(read(tmp_path / "a.exr").light, expected, atol=3e-4)
    files.hdr(tmp_path / "a.hdr", LIGHT, f"PRIMARIES= {' '.join(map(str, primaries))}\n")
    np.testing.assert_allclose(read(tmp_path / "a.hdr").light, expected, atol=7e-3)
    white = np.ones((H, W, 3), np.float32)
    files.exr(tmp_path / "w.exr", white, chromaticities=primaries)
    np.testing.assert_allclose(read(tmp_path / "w.exr").light, 1, atol=1e-5)


def test_half_infinity_is_saturated(tmp_path):
    image = LIGHT.astype(np.float16)
    image[3:5, 4] = np.inf
    files.exr(tmp_path / "a.exr", image)
    picture = read(tmp_path / "a.exr")
    assert np.argwhere(picture.saturated).tolist() == [[3, 4], [4, 4]]
    assert np.isfinite(picture.light).all()
    assert picture.full == 65504
    with pytest.raises(ValueError, match="row 3, column 4"):
        load_environment(tmp_path / "a.exr")


def test_pixel_aspect_of_the_cameras_matrix(tmp_path):
    files.exr(tmp_path / "a.exr", LIGHT, pixelAspectRatio=2.0)
    found = read_picture(tmp_path / "a.exr", Sensor(), (W, H), 2.0)
    np.testing.assert_array_equal(found.light, LIGHT)


XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


@pytest.mark.parametrize(
    ("image", "how"),
    [
        (LIGHT, {}),
        (LIGHT * 4, {"lines": "EXPOSURE=4\n"}),
        (LIGHT * 4, {"lines": "pfilt -1\nEXPOSURE=2\npcomb\nEXPOSURE= 2.0\n\tEXPOSURE=9\n"}),
        (LIGHT * (2, 1, 0.5), {"lines": "COLORCORR= 2 1 0.5\n"}),
        (LIGHT * (4, 2, 1), {"lines": "COLORCORR= 2 1 0.5\nEXPOSURE=2\nVIEW= -vtv\n"}),
        (LIGHT @ XYZ.T, {"format": "xyze"}),
        (2 * LIGHT @ XYZ.T, {"format": "xyze", "lines": "EXPOSURE=2\n"}),
        (LIGHT, {"end": "\r\n"}),
        (LIGHT, {"lines": "oconv " + "x" * 300 + "\n", "packed": False}),
        (LIGHT, {"lines": "PRIMARIES= .640 .330 .300 .600 .150 .060 .3127 .3290\n"}),
        (LIGHT, {"lines": "GAMMA=1.0\n"}),
        (LIGHT[::-1], {"axes": "+Y {h} +X {w}"}),
        (LIGHT[:, ::-1], {"axes": "-Y {h} -X {w}"}),
        (LIGHT[::-1, ::-1], {"axes": "+Y {h} -X {w}"}),
        (LIGHT.swapaxes(0, 1), {"axes": "+X {h} -Y {w}"}),
        (LIGHT[:, ::-1].swapaxes(0, 1), {"axes": "-X {h} -Y {w}"}),
        (LIGHT[::-1].swapaxes(0, 1), {"axes": "+X {h} +Y {w}"}),
        (LIGHT[::-1, ::-1].swapaxes(0, 1), {"axes": "-X {h} +Y {w}"}),
    ],
)
def test_radiance_light_is_upright_and_unexposed(tmp_path, image, how):
    files.hdr(tmp_path / "a.hdr", image, **how)
    assert picture_size(tmp_path / "a.hdr") == (W, H)
    for light in (read(tmp_path / "a.hdr").light, load_environment(tmp_path / "a.hdr")):
        np.testing.assert_allclose(light, LIGHT, atol=0.8 / 60)  # eight bits of the brightest
        assert abs(light / LIGHT - 1).mean() < 0.03


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"lines": "EXPOSURE=0\n"}, "'EXPOSURE=0': expected positive"),
        ({"lines": "EXPOSURE=nan\n"}, "'EXPOSURE=nan': expected positive"),
        ({"lines": "COLORCORR= 1 2\n"}, "'COLORCORR= 1 2': expected positive"),
        ({"lines": "GAMMA=2.2\n"}, "'GAMMA=2.2': write linear"),
        ({"lines": "PRIMARIES= 1 1 1 1 1 1 1 1\n"}, "PRIMARIES: chromaticities"),
        ({"format": "luv"}, "FORMAT '32-bit_rle_luv'"),
        ({"axes": "-X {h} -X {w}"}, "expected X and Y"),
        ({"axes": "-Y 59999 +X {w}"}, "59999 lines of"),
        ({"axes": "-Y {h}"}, "it has no size"),
    ],
)
def test_radiance_headers_that_are_not_light_are_refused(tmp_path, how, says):
    files.hdr(tmp_path / "a.hdr", LIGHT, **how)
    with pytest.raises(ValueError, match=rf"a\.hdr: .*{re.escape(says)}"):
        load_environment(tmp_path / "a.hdr")


def test_the_old_packing_of_radiance_is_refused(tmp_path):
    files.hdr(tmp_path / "a.hdr", np.full((1, 4, 3), 0.5), packed=False)
    data = bytearray((tmp_path / "a.hdr").read_bytes())
    data[-4:] = (1, 1, 1, 1)  # the pixel before it once more
    (tmp_path / "a.hdr").write_bytes(data)
    with pytest.raises(ValueError, match="old packing"):
        load_environment(tmp_path / "a.hdr")


SITES = np.add(2 * (np.arange(H)[:, None] % 2), np.arange(W) % 2)
BY_COLOUR = np.array([200, 256, 264, 330])[SITES]
BY_ROW = 256 + np.arange(H)[:, None] * 4 + np.zeros((H, W))
BY_COLUMN = 256 + np.arange(W) * 3 + np.zeros((H, W))
FOUR = np.array([250, 260, 270, 280])[np.arange(H) % 4][:, None] + np.zeros((H, W))
WHITES = np.array([4000, 4095, 4095, 3800])[SITES]


@pytest.mark.parametrize(
    ("black", "white", "how"),
    [
        (256, 4095, {}),
        (BY_COLOUR, 4095, {"black": (200, 256, 264, 330), "repeat": (2, 2)}),
        (FOUR, 4095, {"black": (250, 260, 270, 280), "repeat": (4, 1)}),
        (BY_ROW, 4095, {"delta_v": [4 * y for y in range(H)]}),
        (BY_COLUMN, 4095, {"delta_h": [3 * x for x in range(W)]}),
        (BY_COLUMN + BY_ROW - 256.5, 4095, {
            "delta_h": [3 * x - 0.5 for x in range(W)], "delta_v": [4 * y for y in range(H)]}),
        (BY_COLOUR + BY_ROW - 256, 4095, {
            "black": (200, 256, 264, 330), "repeat": (2, 2), "delta_v": [4 * y for y in range(H)]}),
        (256, WHITES, {"white": (4000, 4095, 3800)}),
        (0, 65535, {"black": (0,), "white": 65535}),
    ],
)  # fmt: skip
def test_dng_levels_by_colour_row_and_column(tmp_path, black, white, how):
    files.dng(tmp_path / "a.dng", black + files.mosaic(LIGHT) * (white - black), **how)
    picture = read(tmp_path / "a.dng")
    for y, x in ((1, 20), (8, 10), (17, 25)):  # in the flat parts
        np.testing.assert_allclose(picture.light[y, x], LIGHT[y, x], atol=6e-4)
    assert not picture.saturated.any()


def test_a_sensor_that_clips_below_the_stated_white_is_saturated_there(tmp_path):
    light = np.linspace(0.1, 1.5, H * W).reshape(H, W)
    files.dng(tmp_path / "a.dng", np.minimum(256 + light * 3000, 3300), white=4095)
    found = read(tmp_path / "a.dng").saturated
    assert found[np.rint(256 + light * 3000) >= 3300].all()
    assert not found[: H // 2].any()
    files.dng(tmp_path / "b.dng", 256 + light * 2000, white=4095)  # nothing clips
    assert not read(tmp_path / "b.dng").saturated.any()


@pytest.mark.parametrize(
    ("margins", "crop"),
    [
        ((0, 0, 0, 0), None),
        ((4, 6, 2, 8), None),  # masked pixels around the active area
        ((4, 6, 2, 8), (2, 4, 20, 14)),
        ((0, 0, 2, 2), (3, 5, 21, 15)),
    ],
)
def test_dng_pixels_lie_in_the_active_area_or_its_crop(tmp_path, margins, crop):
    """By the camera's size. ActiveArea is top, left, bottom, right; the crop is in it (DNG)."""
    top, left, bottom, right = margins
    counts = np.full((H + top + bottom, W + left + right), 4000.0)
    counts[top : top + H, left : left + W] = BY_COLOUR + files.mosaic(LIGHT) * (4095 - BY_COLOUR)
    more = [(50829, 4, 4, (top, left, top + H, left + W), True)]
    if crop:
        more += [(50719, 3, 2, crop[:2], True), (50720, 3, 2, crop[2:], True)]
    path, levels = tmp_path / "a.dng", {"black": (200, 256, 264, 330), "repeat": (2, 2)}
    files.dng(path, counts, **levels, more=more)
    assert picture_size(path) == (W, H)
    even = (cv2.Laplacian(LIGHT, cv2.CV_32F) == 0).all(axis=-1) * np.uint8(1)
    even = cv2.erode(even, np.ones((5, 5), np.uint8)) > 0
    x, y, w, h = crop or (0, 0, W, H)
    for size, at in (((W, H), np.s_[:, :]), ((w, h), np.s_[y : y + h, x : x + w])):
        found = read(path, size)
        assert picture_size(path, size) == size
        np.testing.assert_allclose(found.light[even[at]], LIGHT[at][even[at]], atol=6e-4)
        assert found.saturated.shape == found.light.shape[:2]


WARP = struct.pack(">I4I", 1, 1, 0x01030000, 0, 4) + bytes(4)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"delta_v": [1, 2, 3]}, "BlackLevelDeltaV has 3 values: expected 24"),
        ({"black": (1, 2, 3), "repeat": (2, 2)}, "BlackLevel has 3 values: expected 4"),
        ({"black": (5000,)}, "black 5000 must be below white 4095"),
        ({"opcodes": WARP}, "OpcodeList2 has WarpRectilinear"),
        (
            {"more": [(50829, 4, 4, (0, 0, H, W), True), (50718, 5, 2, (2, 1, 1, 1), True)]},
            "pixelAspectRatio 2, but",
        ),
    ],
)
def test_dng_levels_that_do_not_fit_are_refused(tmp_path, how, says):
    files.dng(tmp_path / "a.dng", np.full((H, W), 1000), **how)
    with pytest.raises(PictureError, match=rf"a\.dng: {says}"):
        read(tmp_path / "a.dng")


def test_dng_values_are_linear_by_the_table_and_then_above_black(tmp_path):
    """By a table of squares (DNG 1.7, LinearizationTable): what the sensor encoded as its root."""
    table = np.rint(np.linspace(0, 1, 4096) ** 2 * 4095).astype(int)
    counts = np.searchsorted(table, np.rint(256 + files.mosaic(LIGHT) * (4095 - 256)))
    for name, values, ok in (("a.dng", table, True), ("b.dng", table[::-1], False)):
        more = [(50712, 3, len(table), tuple(map(int, values)), True)]
        files.dng(tmp_path / name, counts, more=more)
        if ok:
            light = read(tmp_path / name).light
            for y, x in ((1, 20), (8, 10), (17, 25)):
                np.testing.assert_allclose(light[y, x], LIGHT[y, x], atol=1e-3)
    with pytest.raises(PictureError, match="LinearizationTable decreases"):
        read(tmp_path / "b.dng")


def test_an_active_area_from_an_odd_row_on_is_refused(tmp_path):
    more = [(50829, 4, 4, (3, 6, H + 3, W + 6), True)]
    files.dng(tmp_path / "a.dng", np.full((H + 3, W + 6), 1000), more=more)
    with pytest.raises(PictureError, match="ActiveArea begins at row 3, column 6: expected even"):
        read(tmp_path / "a.dng", picture_size(tmp_path / "a.dng"))


ICC = {
    name: ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()
    for name in ("sRGB", "LAB")
}


def gama(value: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(1e5 * value))


def chrm(xy: tuple[float, ...]) -> tuple[bytes, bytes]:
    return b"cHRM", struct.pack(">8I", *(round(1e5 * v) for v in (*xy[6:], *xy[:6])))


def icc(profile: bytes) -> tuple[bytes, bytes]:
    return b"iCCP", b"x\0\0" + zlib.compress(profile)


def gamma_profile(gamma: float, columns: Any) -> bytes:
    """A matrix profile of one exponent; `columns`: XYZ of red, green and blue under D50."""
    curve = struct.pack(">4sIIH", b"curv", 0, 1, round(gamma * 256)) + b"\0\0"
    xyz = [struct.pack(">4sI3i", b"XYZ ", 0, *(round(65536 * v) for v in c)) for c in columns]
    tags, body = b"", b""
    for name, data in [*zip((b"rXYZ", b"gXYZ", b"bXYZ"), xyz, strict=True),
                       *((n, curve) for n in (b"rTRC", b"gTRC", b"bTRC"))]:  # fmt: skip
        tags += struct.pack(">4sII", name, 132 + 6 * 12 + len(body), len(data))
        body += data
    head = bytearray(128)
    struct.pack_into(">I", head, 0, 132 + len(tags) + len(body))
    head[8:12], head[12:24], head[36:40] = b"\2\x40\0\0", b"mntrRGB XYZ ", b"acsp"
    return bytes(head) + struct.pack(">I", 6) + tags + body


ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
"""XYZ under D50 of Adobe RGB (1998), 4.3.6."""
ADOBE_709 = [[1.3984, -0.3984, 0.0], [0.0, 1.0, 0.0], [0.0, -0.0429, 1.0429]]
SHARE = COUNTS / 65535
BYTES = np.rint(LIGHT * 255).astype(np.uint8)
TWELVE = np.rint(LIGHT * 4095).astype(np.uint16)


@pytest.mark.parametrize(
    ("values", "chunks", "expected"),
    [
        (COUNTS, [], SHARE),
        (COUNTS, [(b"sRGB", b"\0"), gama(0.3)], linear(SHARE)),
        (COUNTS, [gama(0.45455)], SHARE**2.2),
        (BYTES, [gama(1.0)], BYTES / 255),
        (BYTES, [], linear(BYTES / 255)),
        (BYTES, [chrm(P3_D65)], linear(BYTES / 255) @ np.transpose(TO_709[P3_D65])),
        (COUNTS, [gama(1.0), chrm(REC_2020)], SHARE @ np.transpose(TO_709[REC_2020])),
        (COUNTS, [icc(ICC["sRGB"]), gama(1.0)], linear(SHARE)),
        (COUNTS, [icc(gamma_profile(2.19921875, ADOBE))],
         SHARE**2.19921875 @ np.transpose(ADOBE_709)),
        (COUNTS, [(b"cICP", bytes([9, 8, 0, 1])), gama(0.45455)],
         SHARE @ np.transpose(TO_709[REC_2020])),
        (COUNTS, [(b"cICP", bytes([1, 13, 0, 1]))], linear(SHARE)),
        ((TWELVE << 4) + (TWELVE >> 8), [(b"sBIT", b"\x0c\x0c\x0c")], TWELVE / 4095),
        (np.dstack([COUNTS, COUNTS[..., 0] // 3]), [], SHARE),
        (COUNTS[..., 1], [], SHARE[..., [1, 1, 1]]),
        (COUNTS[..., :2], [], SHARE[..., [0, 0, 0]]),
    ],
)  # fmt: skip
def test_png_curves_primaries_and_bits(tmp_path, values, chunks, expected):
    files.png(tmp_path / "a.png", values, chunks)
    np.testing.assert_allclose(read(tmp_path / "a.png").light, expected, atol=1.5e-3)


@pytest.mark.parametrize(
    ("values", "chunks", "says"),
    [
        (TWELVE, [(b"sBIT", b"\x0c\x0c\x0c")], "sBIT 12, .* set sensor.white = 4095"),
        (np.minimum(TWELVE * 3, 4095), [], "values end at 4095 .* set sensor.white = 4095"),
        (COUNTS, [(b"cICP", bytes([9, 16, 0, 1]))], r"primaries 9 with transfer 16 \(PQ\)"),
        (COUNTS, [icc(ICC["sRGB"].replace(b"rTRC", b"xTRC"))], "ICC profile .*sRGB built-in"),
        (COUNTS, [gama(0.0001)], "gAMA 0.0001"),
        (COUNTS, [(b"pHYs", struct.pack(">IIB", 1000, 3000, 0))], "pixelAspectRatio 3"),
    ],
)
def test_png_that_is_not_light_is_refused(tmp_path, values, chunks, says):
    files.png(tmp_path / "a.png", values, chunks)
    with pytest.raises(PictureError, match=rf"a\.png: .*{says}"):
        read(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("values", "how", "expected"),
    [
        (COUNTS, {"byteorder": ">"}, SHARE),
        (COUNTS.transpose(2, 0, 1), {"planarconfig": "separate"}, SHARE),
        (TWELVE, {"extratags": [(281, 3, 3, (4095,) * 3, True)]}, TWELVE / 4095),
        (COUNTS, {"extratags": [(281, 3, 3, (52428,) * 3, True)]}, SHARE),  # statistics
        (65535 - COUNTS[..., 0], {"photometric": "miniswhite"}, SHARE[..., [0] * 3]),
        (255 - BYTES[..., 0], {"photometric": "miniswhite"}, linear(BYTES / 255)[..., [0] * 3]),
        (COUNTS, {"iccprofile": ICC["sRGB"]}, linear(SHARE)),
        (COUNTS, {"iccprofile": gamma_profile(1.0, ADOBE)}, SHARE @ np.transpose(ADOBE_709)),
        (COUNTS, {"extratags": [
            (318, 5, 2, (3127, 10000, 3290, 10000), True),
            (319, 5, 6, sum(((round(1e4 * v), 10000) for v in REC_2020[:6]), ()), True),
        ]}, SHARE @ np.transpose(TO_709[REC_2020])),
        (LIGHT.astype(np.float16), {}, LIGHT),
        (LIGHT.astype(np.float64), {"byteorder": ">"}, LIGHT),
        (COUNTS[..., :2], {"photometric": "minisblack", "planarconfig": "contig",
                           "extrasamples": ["unassalpha"]}, SHARE[..., [0] * 3]),
        (np.dstack([COUNTS, COUNTS[..., 0]]), {"extrasamples": ["assocalpha"]}, SHARE),
        ((BYTES[..., 0] > 100).astype(np.uint8), {
            "photometric": "palette",
            "colormap": np.array([[9, 40000], [9, 20000], [9, 10000]]).repeat(128, 1)},
         None),
        (COUNTS, {"tile": (16, 16), "compression": "zlib", "predictor": True}, SHARE),
    ],
)  # fmt: skip
def test_tiff_layouts(tmp_path, values, how, expected):
    files.tiff(tmp_path / "a.tif", np.ascontiguousarray(values), **how)
    light = read(tmp_path / "a.tif").light
    if expected is None:  # a palette's colours, of 8 bits
        assert len(np.unique(light.reshape(-1, 3), axis=0)) <= 2
    else:
        np.testing.assert_allclose(light, expected, atol=1.5e-3)


@pytest.mark.parametrize(
    ("values", "how", "says"),
    [
        (np.dstack([BYTES, BYTES[..., 0]]), {"photometric": "separated"}, "Interpretation 5"),
        (BYTES, {"photometric": "cielab"}, "PhotometricInterpretation 8"),
        (COUNTS, {"photometric": 34892}, "PhotometricInterpretation 34892"),
        (LIGHT[..., 0], {"photometric": "miniswhite"}, "PhotometricInterpretation 0"),
        (COUNTS, {"extratags": [(281, 3, 3, (4095,) * 3, True)]}, "MaxSampleValue 4095, but"),
        (BYTES, {"extratags": [(301, 3, 256, tuple(range(256)), True)]}, "TransferFunction"),
        (COUNTS, {"resolution": (100, 50)}, "pixelAspectRatio 0.5"),
    ],
)
def test_tiff_that_is_not_light_is_refused(tmp_path, values, how, says):
    files.tiff(tmp_path / "a.tif", values, **how)
    with pytest.raises(PictureError, match=rf"a\.tif: .*{says}"):
        read(tmp_path / "a.tif")


EXIF = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0%c\0\0\0\0\0\0\0"


def oriented(path: Path, orientation: int) -> None:
    """Marks in `BYTES`, stored with an orientation."""
    if path.suffix == ".png":
        files.png(path, BYTES, [gama(1.0), (b"eXIf", EXIF % orientation)])
    elif path.suffix == ".tif":
        files.tiff(path, COUNTS, extratags=[(274, 3, 1, orientation, True)])
    else:
        spec = oiio.ImageSpec(W, H, 3, oiio.UINT8)
        spec.attribute("Orientation", orientation)
        spec.attribute("CompressionQuality", 100)
        out = oiio.ImageOutput.create(str(path))
        assert out.open(str(path), spec)
        assert out.write_image(np.rint(255 * LIGHT ** (1 / 2.2)).astype(np.uint8))
        out.close()


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_by_the_cameras_size_or_the_setting(tmp_path, suffix, orientation):
    path = tmp_path / f"a.{suffix}"
    oriented(path, orientation)
    stored = oiio.ImageBuf(LIGHT)
    stored.specmod().attribute("Orientation", orientation)
    upright = oiio.ImageBufAlgo.reorient(stored).get_pixels(oiio.FLOAT)
    size = (upright.shape[1], upright.shape[0])

    def check(found: Any, expected: Any) -> None:
        assert found.light.shape == expected.shape
        difference = np.abs(found.light - expected)
        assert difference.mean() < 0.03 if suffix == "jpg" else difference.max() < 0.005

    assert picture_size(path, size) == size
    assert picture_size(path) == (W, H)
    check(read(path, size, orientation="turned"), upright)
    check(read(path, (W, H), orientation="stored"), LIGHT)
    if orientation in (2, 3, 4):
        with pytest.raises(PictureError, match=f"EXIF orientation {orientation} .*orientation ="):
            read(path, size)
    else:
        check(read(path, size), upright)
        check(read(path, (W, H)), LIGHT)


def test_a_turned_mask_is_refused(tmp_path):
    files.png(tmp_path / "a.png", BYTES[..., 0] * 0 + 255, [(b"eXIf", EXIF % 6)])
    with pytest.raises(ValueError, match="EXIF orientation 6"):
        decode_mask((tmp_path / "a.png").read_bytes(), W, H)
