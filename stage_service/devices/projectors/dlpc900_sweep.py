"""A scanline sweep as a DLPC900 pattern sequence, one line a pattern.

Source: DLPC900 Programmer's Guide, TI DLPU018 revision J (June 2024): LUT entries (Pattern Display
LUT Configuration, table 2-139), images (Initialize Pattern BMP Load); revision I, table 2-107:
shortest exposures; DLPC900 data sheet, TI DLPS037H: patterns in the controller's memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from stage_service.devices.errors import DeviceError
from stage_service.devices.projectors.dlpc900 import (
    BITS,
    IMAGES,
    Command,
    DisplayMode,
    Led,
    LutEntry,
    Run,
    display_mode,
    load_image,
    lut_configuration,
    run,
    trigger_out,
)
from stage_service.devices.projectors.dlpc900_images import encode, scanlines


@dataclass(frozen=True)
class Dmd:
    """A mirror array: its size, what its controller holds, its shortest exposure of one bit in µs.

    `dual`: two controllers, each with half of every row.
    """

    name: str
    width: int
    height: int
    lut: int
    memory: int
    shortest_us: int
    dual: bool = False

    @property
    def patterns(self) -> int:
        """Patterns of one bit that fit at once: LUT, memory and loadable images."""
        return min(self.lut, self.memory, IMAGES * BITS)


DMDS = {
    dmd.name: dmd
    for dmd in (
        Dmd("DLP5500", 1024, 768, lut=960, memory=1024, shortest_us=83),
        Dmd("DLP6500", 1920, 1080, lut=400, memory=400, shortest_us=105),
        Dmd("DLP9000", 2560, 1600, lut=400, memory=480, shortest_us=105, dual=True),
    )
}


@dataclass(frozen=True)
class Batch:
    """Rows that fit at once: `upload` in its order, then `start`. `seconds` is its running time
    without triggers."""

    rows: tuple[int, ...]
    upload: tuple[Command, ...]
    start: Command
    seconds: float


def encode_sweep(
    dmd: Dmd,
    rows: Sequence[int],
    *,
    exposure_us: int,
    level: float = 1.0,
    dark_us: int = 0,
    triggered: bool = False,
    leds: Led = Led.WHITE,
    inverted: bool = False,
    rising_us: int = 0,
    falling_us: int = 0,
) -> Batch:
    """The commands that show each of `rows` once, in their order, `exposure_us` + `dark_us` each.

    `level`, above 0 to 1, is the share of the exposure that the line is lit, exact to 1 µs: mirrors
    know only on and off. Trigger output 1 is up as long as it is lit; `inverted`, `rising_us` and
    `falling_us` shape it. `triggered`: each row waits for trigger input 1 and is dark after its
    exposure; the next edge may come `dmd.shortest_us` after its dark time. Raises `DeviceError`
    where the rows do not fit at once (see `batches`), `ValueError` for values out of range.
    """
    if not 1 <= len(rows) <= dmd.patterns:
        raise DeviceError(
            dmd.name,
            "encoding a sweep",
            expected=f"1 to {dmd.patterns} patterns, which fit at once (LUT {dmd.lut}, "
            f"memory {dmd.memory}, {IMAGES} images of {BITS})",
            received=f"{len(rows)} rows",
            todo="Split the sweep into batches and load the next when one is over.",
        )
    if not 0 < level <= 1:
        raise ValueError(f"a scanline's level is above 0 and at most 1, got {level}")
    lit_us = round(level * exposure_us)
    if lit_us < dmd.shortest_us:
        raise ValueError(
            f"{dmd.name} shows a line for at least {dmd.shortest_us} µs; {exposure_us} µs at level "
            f"{level:g} are {lit_us} µs: expose longer, or dim the lamp"
        )
    if lit_us + falling_us <= rising_us:
        raise ValueError(
            f"a trigger that rises {rising_us} µs after and falls {falling_us} µs after a line of "
            f"{lit_us} µs is no pulse"
        )
    entries = [
        LutEntry(
            i,
            exposure_us=lit_us,
            dark_us=exposure_us - lit_us + dark_us,
            leds=leds,
            waits=triggered,
            clears=triggered,
            image=i // BITS,
            bit=i % BITS,
        ).command()
        for i in range(len(rows))
    ]
    upload = [
        run(Run.STOP),
        display_mode(DisplayMode.ON_THE_FLY),
        trigger_out(1, inverted=inverted, rising_us=rising_us, falling_us=falling_us),
        *entries,
        lut_configuration(len(rows), shown=len(rows)),
    ]
    for image in reversed(range(-(-len(rows) // BITS))):
        upload += _load(dmd, image, rows[image * BITS : (image + 1) * BITS])
    seconds = len(rows) * (exposure_us + dark_us) * 1e-6
    return Batch(tuple(rows), tuple(upload), run(Run.START), seconds)


def batches(dmd: Dmd, rows: Sequence[int]) -> list[Sequence[int]]:
    """`rows` in as few runs as `encode_sweep` takes, in their order, alike in length within one."""
    count = max(1, -(-len(rows) // dmd.patterns))
    ends = [len(rows) * i // count for i in range(count + 1)]
    return [rows[a:b] for a, b in pairwise(ends)]


def _load(dmd: Dmd, index: int, rows: Sequence[int]) -> list[Command]:
    """The halves of a scanline are alike: both controllers of a dual one get the same bytes."""
    encoded = encode(scanlines(rows, dmd.height, dmd.width // 2 if dmd.dual else dmd.width))
    commands = load_image(index, encoded)
    return commands + load_image(index, encoded, secondary=True) if dmd.dual else commands
