"""Commands of TI's DLPC900 pattern controller as USB HID reports, and its replies.

Source: DLPC900 Programmer's Guide, TI DLPU018, revisions I (November 2023) and J (June 2024):
section 1.2 (reports), 2.1 (status and errors), 2.4 (display mode, triggers, LUT, images); numbers
are little-endian throughout. Byte 9 of a LUT entry follows the guide (bit 0 set: no trigger 2);
TI's own host software sets that bit the other way round, so look at output 2 before relying on it.
Nothing here talks to a device: `dlpc900_images` encodes pictures, `dlpc900_sweep` whole sweeps.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from stage_service.devices.errors import DeviceError, DeviceTimeout

REPORT_BYTES = 64
"""What one HID report carries; in front of it goes the report's number, always 0."""
MOST_DATA = 506
"""Bytes after a command's number: its buffer holds 512 with the header of 4."""
MOST_PACKET = 504
"""Bytes of an image in one Pattern BMP Load."""
IMAGES = 18
"""Images of 24 bits that can be loaded, as the guide's Initialize Pattern BMP Load counts them."""
BITS = 24
"""Patterns of one bit in an image."""

_READ, _REPLY, _FAILED = 0x80, 0x40, 0x20
_INT16, _UINT16, _UINT24, _UINT32 = (-20, 20_000), (0, 0xFFFF), (0, 0xFFFFFF), (0, 0xFFFFFFFF)

ERRORS = {
    0: "no error",
    1: "batch file checksum error",
    2: "device failure",
    3: "invalid command number",
    4: "incompatible controller and DMD",
    5: "command not allowed in this mode",
    6: "invalid command parameter",
    7: "an item that the parameter refers to is not there",
    8: "out of RAM or flash",
    9: "invalid BMP compression",
    10: "pattern bit number out of range",
    11: "pattern BMP not in flash",
    12: "pattern dark time out of range",
    13: "signal delay out of range",
    14: "pattern exposure out of range",
    15: "pattern number out of range",
    16: "invalid pattern definition",
    17: "pattern image address out of range",
    255: "internal error",
}
"""Read Error Code, section 2.1.6."""


class DisplayMode(IntEnum):
    """Section 2.4.1."""

    VIDEO = 0
    PRE_STORED = 1
    VIDEO_PATTERN = 2
    ON_THE_FLY = 3


class Run(IntEnum):
    """Pattern Display Start/Stop: a pause shows its pattern again at the next start."""

    STOP = 0
    PAUSE = 1
    START = 2


class Led(IntFlag):
    """Lamps of a pattern; where light does not come from the controller's drivers: 0."""

    NONE = 0
    RED = 1
    GREEN = 2
    BLUE = 4
    WHITE = 7


class Hardware(IntFlag):
    """Hardware Status, section 2.1.1."""

    INITIALISED = 1
    INCOMPATIBLE_DMD = 2
    DMD_RESET_ERROR = 4
    FORCED_SWAP_ERROR = 8
    SECONDARY_READY = 16
    SEQUENCER_ABORTED = 64
    SEQUENCER_ERROR = 128


FAULTS = (
    Hardware.INCOMPATIBLE_DMD
    | Hardware.DMD_RESET_ERROR
    | Hardware.FORCED_SWAP_ERROR
    | Hardware.SEQUENCER_ABORTED
    | Hardware.SEQUENCER_ERROR
)


@dataclass(frozen=True)
class Command:
    """One command: `doing` names it in errors, `read` says that its answer carries data."""

    number: int
    doing: str
    data: bytes = b""
    read: bool = False

    def reports(self, sequence: int, acknowledge: bool = True) -> list[bytes]:
        """The HID output reports, each the report number 0 and 64 bytes.

        `sequence`, 0 to 255, comes back in the reply. `acknowledge`: a write is answered, too.
        Only the first report has the header; the last is filled with zeros.
        """
        if len(self.data) > MOST_DATA:
            raise ValueError(f"{self.doing}: at most {MOST_DATA} bytes, got {len(self.data)}")
        flags = (_READ | _REPLY) if self.read else (_REPLY if acknowledge else 0)
        payload = self.number.to_bytes(2, "little") + self.data
        header = bytes((flags, sequence)) + len(payload).to_bytes(2, "little")
        message = header + payload
        chunks = (message[i : i + REPORT_BYTES] for i in range(0, len(message), REPORT_BYTES))
        return [b"\0" + chunk.ljust(REPORT_BYTES, b"\0") for chunk in chunks]

    def answer(self, device: str, sequence: int, reports: Iterable[bytes]) -> bytes:
        """The data of a reply, from its input reports (64 bytes each, without a number).

        Raises `DeviceError` where it is another command's reply, or says that this one failed.
        """
        message = b"".join(reports)
        if len(message) < 4:
            raise DeviceTimeout(
                device,
                self.doing,
                expected="a reply",
                received=f"{len(message)} bytes",
                todo="Check USB cable and power of the controller.",
            )
        length = int.from_bytes(message[2:4], "little")
        data = message[4 : 4 + length]
        if message[1] != sequence or len(data) < length:
            raise DeviceError(
                device,
                self.doing,
                expected=f"the reply to command {sequence}",
                received=f"{len(data)} of {length} bytes of the reply to command {message[1]}",
                todo="Drain the controller's reports and send the command again.",
            )
        if message[0] & _FAILED:
            raise DeviceError(
                device,
                self.doing,
                expected="a command carried out",
                received=f"a reply with the error flag to 0x{self.number:04X}",
                todo="Read the error code (0x0100) to learn why.",
            )
        return data


ERROR_CODE = Command(0x0100, "reading the error code", read=True)
ERROR_DESCRIPTION = Command(0x0101, "reading the error's description", read=True)
HARDWARE_STATUS = Command(0x1A0A, "reading the hardware status", read=True)


def error(code: bytes) -> str:
    """The meaning of `ERROR_CODE`'s answer."""
    return ERRORS.get(code[0], f"undefined error {code[0]}")


def error_description(text: bytes) -> str:
    """The text of `ERROR_DESCRIPTION`'s answer; after its end older texts may stand."""
    return text.split(b"\0", 1)[0].decode("ascii", "backslashreplace")


def display_mode(mode: DisplayMode) -> Command:
    """Display Mode Selection; stop the sequence first."""
    return Command(0x1A1B, f"selecting display mode {mode.name}", bytes((mode,)))


def run(state: Run) -> Command:
    """Pattern Display Start/Stop."""
    return Command(0x1A24, f"pattern display {state.name}", bytes((state,)))


def trigger_out(
    output: int, *, inverted: bool = False, rising_us: int = 0, falling_us: int = 0
) -> Command:
    """Trigger Out 1 (up while a pattern is exposed) or 2 (a pulse as each pattern begins).

    The delays, -20 to 20000 µs, shift its edges: output 1 is up for the pattern's exposure
    `+ falling_us - rising_us`. Stop the sequence first.
    """
    if output not in (1, 2):
        raise ValueError(f"the trigger outputs are 1 and 2, got {output}")
    delays = _int("a rising edge's delay in µs", rising_us, 2, _INT16) + _int(
        "a falling edge's delay in µs", falling_us, 2, _INT16
    )
    return Command(0x1A1C + output, f"setting trigger output {output}", bytes((inverted,)) + delays)


def trigger_in_1(delay_us: int, *, falling: bool = False) -> Command:
    """Trigger In 1, which advances patterns: `delay_us` from its active edge to the pattern.

    The delay is at least the DMD's shortest exposure. Stop the sequence first.
    """
    data = _int("the trigger's delay in µs", delay_us, 2, _UINT16) + bytes((falling,))
    return Command(0x1A35, "setting trigger input 1", data)


def trigger_in_2(*, falling: bool = False) -> Command:
    """Trigger In 2, which starts the sequence at its active edge and stops it at the other."""
    return Command(0x1A36, "setting trigger input 2", bytes((falling,)))


@dataclass(frozen=True)
class LutEntry:
    """A pattern of the LUT: Pattern Display LUT Definition.

    `exposure_us` and `dark_us` after it, µs; `bits` 1 to 8, from bit `bit` of image `image` on.
    `waits`: for an edge of trigger input 1. `clears`: a pattern of one bit that waited goes dark
    after its exposure, not at the next edge. `trigger_2`: trigger output 2 marks it.
    """

    index: int
    exposure_us: int
    dark_us: int = 0
    bits: int = 1
    leds: Led = Led.WHITE
    waits: bool = False
    clears: bool = False
    trigger_2: bool = True
    image: int = 0
    bit: int = 0

    def command(self) -> Command:
        """The command; raises `ValueError` beyond what its fields hold."""
        if not 1 <= self.bits <= 8 or not 0 <= self.bit <= BITS - self.bits:
            raise ValueError(
                f"pattern {self.index}: 1 to 8 bits within the image's {BITS}, "
                f"got {self.bits} from bit {self.bit} on"
            )
        flags = self.clears | (self.bits - 1) << 1 | self.leds << 4 | self.waits << 7
        data = (
            _int("a pattern's index", self.index, 2, _UINT16)
            + _int("a pattern's exposure in µs", self.exposure_us, 3, (1, 0xFFFFFF))
            + bytes((flags,))
            + _int("a pattern's dark time in µs", self.dark_us, 3, _UINT24)
            + bytes((not self.trigger_2,))
            + (_within("an image's index", self.image, (0, 255)) | self.bit << 11).to_bytes(
                2, "little"
            )
        )
        return Command(0x1A34, f"defining pattern {self.index}", data)


def lut_configuration(entries: int, shown: int = 0) -> Command:
    """Pattern Display LUT Configuration: makes `entries` definitions effective.

    `shown` patterns are displayed and then it stops; 0: again and again. Stop the sequence first.
    """
    data = _int("the number of LUT entries", entries, 2, (1, 960)) + _int(
        "the number of patterns to display", shown, 4, _UINT32
    )
    return Command(0x1A31, f"configuring a LUT of {entries}", data)


def load_image(index: int, encoded: bytes, *, secondary: bool = False) -> list[Command]:
    """Initialize Pattern BMP Load, then Pattern BMP Load until `encoded`, with its header, is over.

    With two controllers each gets its half of the picture. Load the last image first.
    """
    into = f"image {index} into the {'secondary' if secondary else 'primary'} controller"
    begin = _int("an image's index", index, 2, (0, IMAGES - 1)) + len(encoded).to_bytes(4, "little")
    first, load = (0x1A2C, 0x1A2D) if secondary else (0x1A2A, 0x1A2B)
    packets = (encoded[i : i + MOST_PACKET] for i in range(0, len(encoded), MOST_PACKET))
    return [
        Command(first, f"beginning to load {into}", begin),
        *(
            Command(load, f"loading {into}", len(packet).to_bytes(2, "little") + packet)
            for packet in packets
        ),
    ]


def _within(what: str, value: int, limits: tuple[int, int]) -> int:
    if not limits[0] <= value <= limits[1]:
        raise ValueError(f"{what} is {limits[0]} to {limits[1]}, got {value}")
    return value


def _int(what: str, value: int, size: int, limits: tuple[int, int]) -> bytes:
    return _within(what, value, limits).to_bytes(size, "little", signed=limits[0] < 0)
