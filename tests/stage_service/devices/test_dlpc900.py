"""DLPC900 commands, against the examples of TI's programmer's guide, DLPU018.

Examples that are checked: USB read, its reply, and USB write (revision J, tables 1-5, 1-6, 1-7);
image header (revision I, table 2-109); enhanced RLE (revision I, table 2-113); the pre-stored and
the on-the-fly sequence (revision I).
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stage_service.devices.errors import DeviceError, DeviceTimeout
from stage_service.devices.projectors import dlpc900
from stage_service.devices.projectors.dlpc900 import (
    FAULTS,
    Command,
    DisplayMode,
    Hardware,
    Led,
    LutEntry,
    Run,
)
from stage_service.devices.projectors.dlpc900_images import (
    Image,
    composite,
    encode,
    encode_line,
    scanlines,
)
from stage_service.devices.projectors.dlpc900_sweep import DMDS, Batch, batches, encode_sweep

CURTAIN = 0x1100
DLP6500 = DMDS["DLP6500"]


def report(text: str) -> bytes:
    return bytes.fromhex(text).ljust(65, b"\0")


def pixels(text: str) -> Image:
    return np.array([int(p, 16) for p in text.split()], np.uint32)


def expand(data: bytes, width: int) -> Image:
    """Table 2-112 read as the controller does; end-of-line codes may stand or not."""
    lines: list[list[int]] = [[]]
    at = 0

    def count() -> int:
        nonlocal at
        n = data[at]
        at += 1
        if n & 0x80:
            n = n & 0x7F | data[at] << 7
            at += 1
        return n

    def pixel() -> int:
        nonlocal at
        at += 3
        return int.from_bytes(data[at - 3 : at], "big")

    while True:
        if len(lines[-1]) == width:
            lines.append([])
        line = lines[-1]
        if data[at]:
            n = count()
            line += [pixel()] * n
        elif data[at + 1] == 0:
            at += 2
        elif data[at + 1] == 1 and data[at + 2] == 0:
            assert at + 3 == len(data)
            return np.array(lines[:-1] if not line else lines, np.uint32)
        elif data[at + 1] == 1:
            at += 2
            n = count()
            line += lines[-2][len(line) : len(line) + n]
        else:
            at += 1
            line += [pixel() for _ in range(count())]
        assert len(line) <= width


def test_a_read_and_a_write_are_the_guides_example_reports() -> None:
    read = Command(CURTAIN, "reading the curtain", read=True)
    assert read.reports(0x11) == [report("00 C0 11 02 00 00 11")]
    write = Command(CURTAIN, "setting the curtain", bytes.fromhex("FF 01 FF 01 FF 01"))
    assert write.reports(0x12, acknowledge=False) == [
        report("00 00 12 08 00 00 11 FF 01 FF 01 FF 01")
    ]
    assert write.reports(0x12)[0][1] == 0x40


def test_a_reply_is_read_as_in_the_guides_example() -> None:
    read = Command(CURTAIN, "reading the curtain", read=True)
    reply = report("00 C0 11 06 00 FF 01 FF 01 FF 01")[1:]
    assert read.answer("dmd", 0x11, [reply]) == bytes.fromhex("FF 01 FF 01 FF 01")


def test_a_long_command_has_its_header_in_the_first_report_only() -> None:
    data = bytes(range(256)) + bytes(250)
    reports = Command(0x1A2B, "loading", data).reports(7)
    assert [len(r) for r in reports] == [65] * 8
    assert b"".join(r[1:] for r in reports) == b"\x40\x07\xfc\x01\x2b\x1a" + data
    with pytest.raises(ValueError, match="at most 506 bytes, got 507"):
        Command(0x1A2B, "loading", bytes(507)).reports(7)


def test_a_reply_over_several_reports_is_put_together() -> None:
    text = b"Pattern exposure time is out of range, which takes more than one report to say"
    message = b"\xc0\x05\x80\x00" + text.ljust(128, b"\0")
    parts = [message[i : i + 64].ljust(64, b"\0") for i in range(0, len(message), 64)]
    data = dlpc900.ERROR_DESCRIPTION.answer("dmd", 5, parts)
    assert dlpc900.error_description(data) == text.decode()


def test_a_failed_command_names_itself_and_where_the_reason_is_read() -> None:
    with pytest.raises(DeviceError, match=r"dmd: pattern display START: .*0x1A24.*error code"):
        dlpc900.run(Run.START).answer("dmd", 1, [report("00 60 01 00 00")[1:]])


@pytest.mark.parametrize(
    ("reply", "error", "received"),
    [
        (b"", DeviceTimeout, "0 bytes"),
        (bytes.fromhex("C0 02 01 00 07"), DeviceError, "reply to command 2"),
        (bytes.fromhex("C0 01 05 00 07"), DeviceError, "1 of 5 bytes"),
    ],
    ids=["none", "of another command", "cut short"],
)
def test_a_reply_that_is_not_the_answer_is_refused(
    reply: bytes, error: type[DeviceError], received: str
) -> None:
    with pytest.raises(error, match=received):
        dlpc900.HARDWARE_STATUS.answer("dmd", 1, [reply])


def test_error_codes_and_hardware_status_have_their_meaning() -> None:
    assert dlpc900.error(b"\x0e") == "pattern exposure out of range"
    assert dlpc900.error(b"\xff") == "internal error"
    assert dlpc900.error(b"\x20") == "undefined error 32"
    assert not Hardware(0x01) & FAULTS
    assert Hardware(0x81) & FAULTS == Hardware.SEQUENCER_ERROR


def sent(command: Command) -> tuple[int, str]:
    return command.number, command.data.hex(" ").upper()


def test_the_pre_stored_example_is_encoded_as_the_guide_has_it() -> None:
    """Its pattern 1 is said to have 2 bits; its byte 21 means one bit, cleared, green."""
    commands = [
        dlpc900.display_mode(DisplayMode.PRE_STORED),
        LutEntry(0, 200, leds=Led.RED).command(),
        LutEntry(1, 400, leds=Led.GREEN, clears=True, bit=1).command(),
        dlpc900.lut_configuration(2),
        dlpc900.run(Run.START),
    ]
    assert [sent(command) for command in commands] == [
        (0x1A1B, "01"),
        (0x1A34, "00 00 C8 00 00 10 00 00 00 00 00 00"),
        (0x1A34, "01 00 90 01 00 21 00 00 00 00 00 08"),
        (0x1A31, "02 00 00 00 00 00"),
        (0x1A24, "02"),
    ]


def test_the_on_the_fly_example_is_encoded_as_the_guide_has_it() -> None:
    image = bytes(range(251)) * 24 + bytes(33)
    commands = [
        dlpc900.display_mode(DisplayMode.ON_THE_FLY),
        LutEntry(0, 200, leds=Led.RED, clears=True).command(),
        LutEntry(1, 400, leds=Led.GREEN, clears=True, bits=2, bit=1).command(),
        dlpc900.lut_configuration(2),
        *dlpc900.load_image(0, image),
        dlpc900.run(Run.START),
    ]
    assert len(image) == 6057
    assert [sent(command) for command in commands[:5]] == [
        (0x1A1B, "03"),
        (0x1A34, "00 00 C8 00 00 11 00 00 00 00 00 00"),
        (0x1A34, "01 00 90 01 00 23 00 00 00 00 00 08"),
        (0x1A31, "02 00 00 00 00 00"),
        (0x1A2A, "00 00 A9 17 00 00"),
    ]
    packets = commands[5:-1]
    assert {p.number for p in packets} == {0x1A2B}
    assert [p.data[:2].hex() for p in packets] == ["f801"] * 12 + ["0900"]
    assert b"".join(p.data[2:] for p in packets) == image
    assert sent(commands[-1]) == (0x1A24, "02")


def test_triggers_carry_polarity_and_signed_delays() -> None:
    out = dlpc900.trigger_out(1, inverted=True, rising_us=-20, falling_us=20_000)
    assert sent(out) == (0x1A1D, "01 EC FF 20 4E")
    assert sent(dlpc900.trigger_out(2)) == (0x1A1E, "00 00 00 00 00")
    assert sent(dlpc900.trigger_in_1(105, falling=True)) == (0x1A35, "69 00 01")
    assert sent(dlpc900.trigger_in_2()) == (0x1A36, "00")
    with pytest.raises(ValueError, match="-20 to 20000, got -21"):
        dlpc900.trigger_out(1, rising_us=-21)
    with pytest.raises(ValueError, match="outputs are 1 and 2"):
        dlpc900.trigger_out(3)


def test_lut_fields_stay_within_their_bits() -> None:
    full = LutEntry(
        0x1FF, 0xFFFFFF, 0xABCDEF, 8, waits=True, trigger_2=False, image=255, bit=16
    ).command()
    assert sent(full)[1] == "FF 01 FF FF FF FE EF CD AB 01 FF 80"
    for wrong in (
        LutEntry(0, 0),
        LutEntry(0, 1 << 24),
        LutEntry(0, 200, -1),
        LutEntry(0, 200, bits=9),
        LutEntry(0, 200, bits=2, bit=23),
        LutEntry(0, 200, image=256),
    ):
        with pytest.raises(ValueError, match="got"):
            wrong.command()


def test_lines_are_compressed_as_in_the_guides_example() -> None:
    """The guide repeats `82 01` 513 times; by its rule, low 7 bits first, it stands for 130."""
    first = pixels(
        "040506 " * 3 + "777777 " * 5 + "040506 070809 0A0B0C " + "789ABC " * 130,
    )
    second = pixels("010203 " + "040506 " * 2 + "777777 " * 5 + "040506 070809")
    none = np.zeros(0, np.uint32)
    guide = bytes.fromhex(
        "03 040506 05 777777 00 03 040506 070809 0A0B0C 82 01 789ABC 01 010203 00 01 09"
    )
    assert encode_line(first, none) + encode_line(second, first) == guide


def test_the_guides_end_of_line_codes_are_read_like_none() -> None:
    line = "03 040506 05 777777"
    end = "00 01 00"
    with_codes = bytes.fromhex(f"{line} 00 00 00 01 08 00 00 {end}")
    without = bytes.fromhex(f"{line} 00 01 08 {end}")
    image = expand(with_codes, 8)
    assert np.array_equal(image, expand(without, 8))
    assert encode(image)[48:] == without


def test_the_header_is_the_guides() -> None:
    encoded = encode(np.zeros((1080, 1920), np.uint32))
    assert encoded[:48] == bytes.fromhex("53706c64 8007 3804") + (len(encoded) - 48).to_bytes(
        4, "little"
    ) + b"\xff" * 8 + bytes((0, 0, 0, 0, 0, 2, 1)) + bytes(21)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_every_image_comes_back_from_its_compression(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 6)), data.draw(st.sampled_from([1, 2, 9, 127, 300]))
    colours = data.draw(st.sampled_from([1, 2, 3, 1 << 24]))
    rng = np.random.default_rng(data.draw(st.integers(0, 1 << 32)))
    image = rng.integers(0, colours, (height, width)).astype(np.uint32)
    alike = rng.random(height) < 0.4
    for y in range(1, height):
        if alike[y]:
            image[y, width // 3 :] = image[y - 1, width // 3 :]
    encoded = encode(image)
    assert np.array_equal(expand(encoded[48:], width), image)
    assert len(encoded) <= 48 + 3 * image.size + 3 * height * width + 3


def test_more_than_24_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="24 bits"):
        encode(np.full((1, 1), 1 << 24, np.uint32))
    with pytest.raises(ValueError, match="1 to 24 patterns"):
        composite([np.zeros((1, 1), np.bool_)] * 25)
    with pytest.raises(ValueError, match="0 to 767"):
        scanlines([768], 768, 4)


def test_pattern_b_is_bit_b_and_bit_23_goes_first() -> None:
    patterns = [np.zeros((2, 3), np.bool_) for _ in range(24)]
    patterns[23][0] = patterns[8][1] = patterns[0][1] = True
    image = composite(patterns)
    assert image.tolist() == [[1 << 23] * 3, [0x101] * 3]
    assert encode(image)[48:] == bytes.fromhex("03 800000 03 000101 00 01 00")


def test_scanlines_are_the_composite_of_their_pictures() -> None:
    rows = [3, 0, 3, 5]
    patterns = [np.zeros((6, 4), np.bool_) for _ in rows]
    for pattern, row in zip(patterns, rows, strict=True):
        pattern[row] = True
    assert np.array_equal(scanlines(rows, 6, 4), composite(patterns))


def images(batch: Batch, width: int, *, first: int = 0x1A2A) -> dict[int, Image]:
    """The pictures of an upload, put together and expanded."""
    found: dict[int, bytes] = {}
    sizes: dict[int, int] = {}
    index = -1
    for command in batch.upload:
        if command.number == first:
            index = int.from_bytes(command.data[:2], "little")
            sizes[index] = int.from_bytes(command.data[2:], "little")
            found[index] = b""
        elif command.number == first + 1:
            assert int.from_bytes(command.data[:2], "little") == len(command.data) - 2
            found[index] += command.data[2:]
    assert {i: len(data) for i, data in found.items()} == sizes
    assert list(found) == sorted(found, reverse=True), "the last image is loaded first"
    return {i: expand(data[48:], width) for i, data in found.items()}


def lit_rows(batch: Batch, width: int, *, first: int = 0x1A2A) -> list[list[int]]:
    """Which rows each entry of the LUT shows, all of them from edge to edge."""
    loaded = images(batch, width, first=first)
    shown = []
    for command in batch.upload:
        if command.number == 0x1A34:
            place = int.from_bytes(command.data[10:], "little")
            plane = loaded[place & 0x7FF] >> np.uint32(place >> 11) & 1
            assert (plane == plane[:, :1]).all()
            shown.append(np.flatnonzero(plane[:, 0]).tolist())
    return shown


def test_a_sweep_shows_each_of_its_rows_once_in_order() -> None:
    rows = [*range(1079, 1029, -1), 0, 7, 7]
    batch = encode_sweep(DLP6500, rows, exposure_us=20_000)
    assert lit_rows(batch, 1920) == [[row] for row in rows]
    numbers = [command.number for command in batch.upload]
    assert numbers[:3] == [0x1A24, 0x1A1B, 0x1A1D]
    assert numbers[3 : 3 + len(rows) + 1] == [0x1A34] * len(rows) + [0x1A31]
    configured = next(c for c in batch.upload if c.number == 0x1A31)
    assert configured.data == bytes((53, 0, 53, 0, 0, 0))
    assert sent(batch.upload[0]) == (0x1A24, "00")
    assert sent(batch.start) == (0x1A24, "02")
    assert batch.seconds == pytest.approx(53 * 0.02)


def test_both_controllers_of_a_large_mirror_get_their_half() -> None:
    rows = [0, 800, 1599]
    batch = encode_sweep(DMDS["DLP9000"], rows, exposure_us=1000)
    for first in (0x1A2A, 0x1A2C):
        assert lit_rows(batch, 1280, first=first) == [[row] for row in rows]


def test_level_is_the_share_of_the_exposure_that_the_line_is_lit() -> None:
    batch = encode_sweep(DLP6500, [4], exposure_us=20_000, level=0.25, dark_us=500, triggered=True)
    entry = next(c.data for c in batch.upload if c.number == 0x1A34)
    assert int.from_bytes(entry[2:5], "little") == 5000
    assert int.from_bytes(entry[6:9], "little") == 15_500
    assert entry[5] == 0xF1, "waits, white, one bit, cleared"
    with pytest.raises(ValueError, match=r"at least 105 µs; 1000 µs at level 0\.1 are 100 µs"):
        encode_sweep(DLP6500, [4], exposure_us=1000, level=0.1)
    with pytest.raises(ValueError, match="above 0"):
        encode_sweep(DLP6500, [4], exposure_us=1000, level=0.0)
    with pytest.raises(ValueError, match="no pulse"):
        encode_sweep(DLP6500, [4], exposure_us=1000, rising_us=990, falling_us=-20)


@pytest.mark.parametrize(
    ("name", "fits", "runs"), [("DLP5500", 432, 2), ("DLP6500", 400, 2), ("DLP9000", 400, 2)]
)
def test_what_does_not_fit_is_refused_with_how_many_do(name: str, fits: int, runs: int) -> None:
    dmd, rows = DMDS[name], range(768)
    with pytest.raises(DeviceError, match=rf"{name}: .*1 to {fits} patterns.*768 rows.*batches"):
        encode_sweep(dmd, rows, exposure_us=20_000)
    split = batches(dmd, rows)
    assert len(split) == runs
    assert [row for run in split for row in run] == list(rows)
    assert max(map(len, split)) <= fits
    assert batches(dmd, range(fits)) == [range(fits)]


def test_a_whole_sweep_compresses_a_thousand_times_and_more() -> None:
    sweep = [encode_sweep(DLP6500, run, exposure_us=20_000) for run in batches(DLP6500, range(768))]
    loaded = sum(len(c.data) for b in sweep for c in b.upload if c.number == 0x1A2B)
    assert loaded * 1000 < 768 * 1920 * 1080 // 8
