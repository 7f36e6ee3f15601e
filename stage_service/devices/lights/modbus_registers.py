"""The light bank's register map: overlaps, and the owner's name as registers."""

from __future__ import annotations

from reconstruction.geometry.rig import RigError
from stage_service.device_config import OWNER_WORDS, LightRegisters

TABLE_ENTRIES = 4096


def check_apart(registers: LightRegisters, lamps: int) -> None:
    """Raise `RigError` where two holding registers share an address: a level written to the
    selector would be a command."""
    many = {"levels": lamps, "owner": OWNER_WORDS, "table": 2 * TABLE_ENTRIES}
    found: dict[int, str] = {}
    for name in ("levels", "selector", "heartbeat", "watchdog", "sequence", "owner", "table"):
        first = getattr(registers, name)
        for address in () if first is None else range(first, first + many.get(name, 1)):
            if (other := found.setdefault(address, name)) != name:
                raise RigError(
                    f"devices.lights.registers: {name} overlaps {other} at {address}, with "
                    f"{lamps} lamps: give each the addresses that the bank has"
                )


def words_of(name: str) -> list[int]:
    """A name as the registers behind the owner's number: two characters each, then zeros."""
    data = name.encode("ascii", "replace")[: 2 * (OWNER_WORDS - 1)].ljust(
        2 * (OWNER_WORDS - 1), b"\0"
    )
    return [data[i] << 8 | data[i + 1] for i in range(0, len(data), 2)]


def text_of(words: list[int]) -> str:
    """The name in these registers."""
    data = b"".join(word.to_bytes(2, "big") for word in words).partition(b"\0")[0]
    return "".join(c if c.isprintable() else "?" for c in data.decode("ascii", "replace"))
