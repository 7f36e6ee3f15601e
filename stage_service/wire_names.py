"""Names of a rig file that its wires can carry; see `docs/reference/wire.md`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

LONGEST_PROJECTOR_NAME = 32
"""Characters, so that the longest request, ENTRY, fits into 96."""
_PROJECTOR = re.compile(rf"[A-Za-z0-9._-]{{1,{LONGEST_PROJECTOR_NAME}}}")
_SERIAL_NUMBER = re.compile(r"[A-Za-z0-9._-]{1,64}|usb:\d+,\d+")
_CHARACTERS = "the letters A to Z and a to z, digits, '.', '_' and '-'"


def unfit_projectors(names: Sequence[str]) -> Iterator[str]:
    """A sentence for each name that the projector controller's ASCII lines cannot carry."""
    allowed = f"1 to {LONGEST_PROJECTOR_NAME} characters of {_CHARACTERS}"
    for number, name in enumerate(names, 1):
        if not _PROJECTOR.fullmatch(name):
            place = f"[[projectors]] number {number}: name"
            yield f"{place}: the projector controller takes {allowed}, got {name[:60]!r}"


def unfit_serials(serials: Mapping[str, str], cameras: Sequence[str]) -> Iterator[str]:
    """A sentence for each camera without a serial number, and each serial number without a camera
    or with invalid characters."""
    place = "devices.cameras.serials"
    for camera in cameras:
        if camera not in serials:
            yield f"{place}: the serial number of the camera {camera!r} is missing"
    for camera, serial in serials.items():
        if camera not in cameras:
            yield f"{place}.{camera}: the rig has no camera {camera!r}"
        elif not _SERIAL_NUMBER.fullmatch(serial):
            yield f"{place}.{camera}: expected {_CHARACTERS} alone, got {serial[:60]!r}"
