"""Light banks on DMX over a network: sACN (ANSI E1.31-2018) and Art-Net 4.

No library sends the packets: `sacn` repeats the last frame from a thread that outlives a failed
main thread, and `stupidArtnet` only prints that a send failed. Neither protocol confirms a frame.
Each is sent twice, one DMX frame apart, so that a lost packet has no effect, and repeated while the
link is open: receivers would take a silent source for a lost one.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
import uuid
from abc import abstractmethod
from collections.abc import Sequence
from contextlib import suppress

from reconstruction.geometry.rig import RigError
from stage_service.device_config import ArtNetConfig, SacnConfig
from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable
from stage_service.devices.lights import limits
from stage_service.devices.lights.dmx import CHANNELS, FRAME_S, DmxBank

KEEP_ALIVE_S = 0.8
"""E1.31 §6.6.2 and Art-Net have 0.8 to 1 s between two packets of an unchanged frame."""
_TERMINATIONS = 3  # E1.31 §6.2.6
_SACN = struct.Struct(">HH12s HI16s HI64sBHBBH HBBHHHB")
_TERMINATED = 0x40
_ID = b"Art-Net\0"
_ART_POLL, _ART_POLL_REPLY, _ART_DMX, _VERSION = 0x2000, 0x2100, 0x5000, 14
_STATUS_3 = 217  # its place in an ArtPollReply
_FAIL_SAFES = ("hold", "zero", "full", "scene")


class _NetworkBank(DmxBank):
    """Frames as datagrams to `target(u)`; `close` ends their repetition."""

    local_port = 0
    last_universe: int

    def __init__(self, protocol: str, config: SacnConfig | ArtNetConfig, lamps: int) -> None:
        place = config.host or f"universe {config.universe}"
        super().__init__(f"light bank ({protocol}, {place})", config, lamps)
        last = config.universe + self.universes - 1
        if last > self.last_universe:
            raise RigError(f"devices.lights: its last universe would be {last}")
        self.config = config
        self._frames: Sequence[bytes] = ()
        self._socket: socket.socket | None = None
        self._stop = threading.Event()
        self._sequence = 0

    def connect(self) -> None:
        """Open the link; `DeviceError` unless the rig file accepts that a blackout cannot be
        verified."""
        accepted = self.config.accept_unverified_blackout
        limits.refuse_unverified_blackout(self.name, self.capabilities, accepted)
        with self._lock:
            self._open("opening the link")

    def close(self) -> None:
        with self._lock:
            self._stop.set()
            if self._socket is not None:
                self._socket.close()
            self._socket, self._frames = None, ()

    @abstractmethod
    def packet(self, universe: int, frame: bytes) -> bytes:
        """The datagram with a frame for the universe, from 0."""

    def target(self, _universe: int) -> tuple[str, int]:
        """The address of a universe's datagrams."""
        return self.config.host, self.config.port

    def _open(self, doing: str) -> None:
        if self._socket is not None:
            return
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind(("", self.local_port))
            if self.config.host:  # a connected socket reports a port that nobody listens to
                self._socket.connect(self.target(0))
        except OSError as error:
            raise self._lost(doing, error) from error
        self._stop = threading.Event()
        threading.Thread(
            target=self._repeat, args=(self._stop,), name=self.name, daemon=True
        ).start()

    def _transmit(self, frames: Sequence[bytes], doing: str) -> None:
        self._open(doing)
        self._frames = frames
        try:
            for _ in range(2):
                self._send(frames)
                time.sleep(FRAME_S)
        except OSError as error:
            raise self._lost(doing, error) from error
        time.sleep(FRAME_S)

    def _send(self, frames: Sequence[bytes]) -> None:
        assert self._socket is not None
        self._sequence = self._sequence % 255 + 1  # Art-Net has no 0
        for universe, frame in enumerate(frames):
            self._socket.sendto(self.packet(universe, frame), self.target(universe))

    def _repeat(self, stop: threading.Event) -> None:
        while not stop.wait(KEEP_ALIVE_S):
            with self._lock, suppress(OSError):  # the next command reports it
                if not stop.is_set():
                    self._send(self._frames)

    def _lost(self, doing: str, error: OSError) -> DeviceUnreachable:
        self.close()
        todo = "Its lamps may still be lit. Check power, network and host in [devices.lights]."
        return DeviceUnreachable(self.name, doing, "a receiver", str(error), todo)


class SacnBank(_NetworkBank):
    """Lamps on sACN receivers; `close` darkens them and ends the stream."""

    config: SacnConfig
    last_universe = 63999

    def __init__(self, config: SacnConfig, lamps: int) -> None:
        super().__init__("sACN", config, lamps)
        # Of this driver alone: receivers drop frames of a known source that restarts its numbers.
        self._cid = uuid.uuid4().bytes
        self._options = 0

    def close(self) -> None:
        with self._lock, suppress(OSError):
            self._options = _TERMINATED
            dark = [bytes(CHANNELS)] * len(self._frames)  # receivers may hold the last frame
            for _ in range(_TERMINATIONS if self._socket is not None else 0):
                self._send(dark)
        super().close()
        self._options = 0

    def target(self, universe: int) -> tuple[str, int]:
        number = self.config.universe + universe
        return self.config.host or f"239.255.{number >> 8}.{number & 255}", self.config.port

    def packet(self, universe: int, frame: bytes) -> bytes:
        """An E1.31 data packet (§4, tables 4-1 to 4-3)."""
        size = _SACN.size + CHANNELS
        root, framing, dmp = (0x7000 | size - start for start in (16, 38, 115))
        name = b"hairstage"
        # fmt: off
        return _SACN.pack(
            0x0010, 0, b"ASC-E1.17", root, 4, self._cid,
            framing, 2, name, self.config.priority, 0, self._sequence, self._options,
            self.config.universe + universe,
            dmp, 2, 0xA1, 0, 1, 1 + CHANNELS, 0,
        ) + frame
        # fmt: on


class ArtNetBank(_NetworkBank):
    """Lamps on one Art-Net node. What they do when the frames stop is the node's setting."""

    config: ArtNetConfig
    last_universe = 32767

    def __init__(self, config: ArtNetConfig, lamps: int) -> None:
        super().__init__("Art-Net", config, lamps)
        self.local_port = config.port  # nodes reply to this port

    def connect(self) -> None:
        """As the others, and poll the node; `DeviceError` for one that lights lamps when frames
        stop."""
        super().connect()
        with self._lock:
            self._check_fail_safe("polling the node")

    def packet(self, universe: int, frame: bytes) -> bytes:
        head = struct.pack("<8sH", _ID, _ART_DMX) + struct.pack(">HBB", _VERSION, self._sequence, 0)
        address = struct.pack("<H", self.config.universe + universe)
        return head + address + struct.pack(">H", CHANNELS) + frame

    def _check_fail_safe(self, doing: str) -> None:
        assert self._socket is not None
        timeout_s = self.config.timeout_s
        deadline = time.monotonic() + timeout_s
        poll = struct.pack("<8sH", _ID, _ART_POLL) + struct.pack(">HBB", _VERSION, 0, 0)
        try:
            self._socket.send(poll)
            while not (reply := self._receive(deadline)).startswith(
                struct.pack("<8sH", _ID, _ART_POLL_REPLY)
            ):
                pass
        except TimeoutError as error:
            self.close()
            todo = "Check power, network and host in [devices.lights]."
            received = "nothing"
            raise DeviceTimeout(self.name, doing, "a reply", received, todo, timeout_s) from error
        except OSError as error:
            raise self._lost(doing, error) from error
        # A reply that ends before is of an earlier version, which has no such setting.
        fail_safe = _FAIL_SAFES[reply[_STATUS_3] >> 6 if len(reply) > _STATUS_3 else 0]
        if fail_safe in ("full", "scene"):
            self.close()
            todo = "Set the node's fail-safe to zero: as it is, it lights lamps when frames stop."
            raise DeviceError(self.name, doing, "fail-safe zero or hold", fail_safe, todo)

    def _receive(self, deadline: float) -> bytes:
        assert self._socket is not None
        self._socket.settimeout(max(1e-3, deadline - time.monotonic()))
        if time.monotonic() > deadline:
            raise TimeoutError
        return self._socket.recv(1024)
