"""A node with dimmers on a network: a receiver of sACN (ANSI E1.31-2018) or Art-Net 4 (1.4dh)."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from simulators.peers.faults import Fault
from simulators.peers.lamps import Lamps
from stage_service.device_config import ArtNetConfig, SacnConfig

HOST = "127.0.0.2"  # not the clients' address: both ends of Art-Net have the same port
LOSS_S = 2.5  # E131_NETWORK_DATA_LOSS_TIMEOUT
_ACN = bytes.fromhex("0010 0000 4153432d45312e3137000000")
_ANOTHER = "another source"


@dataclass
class _Source:
    """A sender's newest frame for one universe."""

    priority: int = 0
    sequence: int = 0
    heard: float = 0.0
    slots: bytes = b""
    packet: bytes = field(default=b"", repr=False)


class DmxNode:
    """Shows the universes from `config.universe` on by `lamps`, highest level first among the
    sources of the highest priority. A source that is silent for 2.5 s is lost: an sACN node then
    goes dark, an Art-Net node holds its frame, as most do by default; `fail_safe` is the state that
    an Art-Net node reports.

    `strikes` gets "poll", or "dmx" and the universe's number.
    """

    def __init__(
        self,
        lamps: Lamps,
        config: SacnConfig | ArtNetConfig,
        port: int,
        strikes: Callable[[str], Fault | None] = lambda _request: None,
        begun: Callable[[str], bool] = lambda _fault: False,
    ) -> None:
        lamps.without_dead_man()
        self._lamps, self._config, self._port = lamps, config, port
        self._strikes, self._begun = strikes, begun
        self._acn = isinstance(config, SacnConfig)
        self._sources: dict[tuple[str, int], _Source] = {}
        self._shown = [0] * lamps.count
        self.fail_safe = 0
        self.packets = 0
        self._stopping, self._lock = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._run, name="DMX node", daemon=True)

    def start(self) -> int:
        """Listen and return the port. Raises `OSError` when the address is taken."""
        self._listen()
        self._thread.start()
        return self._port

    def stop(self) -> None:
        """Close the port."""
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def idle(self) -> bool:
        """Whether it has executed all that has arrived."""
        with self._lock:
            return not select.select([self._socket], [], [], 0)[0]

    def _listen(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind((HOST, self._port))
        self._port = self._socket.getsockname()[1]

    def _run(self) -> None:
        while not self._stopping.is_set():
            ready, _, _ = select.select([self._socket], [], [], 0.02)
            with self._lock:
                if ready:
                    packet, sender = self._socket.recvfrom(2048)
                    if not self._begun("hang"):
                        self._take(packet, sender)
                self._forget()
                self._show()

    def _take(self, packet: bytes, sender: tuple[str, int]) -> None:
        poll = packet[:10] == b"Art-Net\0\x00\x20" and len(packet) >= 14
        found = None if poll else (_acn if self._acn else _art)(packet)
        if not poll and found is None:
            return
        universe = 0 if found is None else found[0]
        fault = self._strikes("poll" if poll else f"dmx {universe}")
        kind = None if fault is None else fault.kind
        if fault is not None and kind == "unplug":
            self._socket.close()
            self._stopping.wait(fault.seconds)
            self._listen()
            return
        if kind == "drop":
            return
        if poll and not self._acn:
            if fault is not None and kind == "late":
                self._stopping.wait(fault.seconds)
            if kind != "silent":
                self._socket.sendto(_poll_reply(self._port, self.fail_safe), sender)
        elif found is not None:
            self.packets += 1
            name = packet[22:38].hex() if self._acn else sender[0]
            before = self._sources.get((name, universe))
            self._accept(name, packet, *found)
            again = None if before is None else (_acn if self._acn else _art)(before.packet)
            if kind == "repeat" and again is not None and before is not None:
                self._accept(name, before.packet, *again)

    def _accept(
        self, name: str, packet: bytes, universe: int, priority: int, sequence: int, slots: bytes
    ) -> None:
        """Take a frame unless a later one has come (E1.31 §6.7.2); empty `slots` end the stream."""
        before = self._sources.get((name, universe))
        if before is not None and -20 < (sequence - before.sequence + 128) % 256 - 128 <= 0:
            return
        if not slots:
            self._sources.pop((name, universe), None)
            return
        heard = time.monotonic()
        self._sources[name, universe] = _Source(priority, sequence, heard, slots, packet)

    def _forget(self) -> None:
        if self._begun("override"):
            now, full = time.monotonic(), bytes([255]) * 512
            priority = 200 if self._acn else 0
            for universe in range(self._config.universe, self._config.universe + 16):
                self._sources[_ANOTHER, universe] = _Source(priority, 0, now, full)
        late = time.monotonic() - LOSS_S
        lost = [key for key, source in self._sources.items() if source.heard < late]
        for key in lost if self._acn else ():
            del self._sources[key]

    def _show(self) -> None:
        config, count = self._config, self._lamps.count
        first, width = config.first_channel - 1, config.channels
        universes: list[np.ndarray] = []
        while sum(len(u) for u in universes) < count * width:
            number = config.universe + len(universes)
            found = [s for (_, u), s in self._sources.items() if u == number]
            top = max((s.priority for s in found), default=0)
            slots = np.zeros(512, np.int64)
            for source in found:
                if source.priority == top:
                    own = np.frombuffer(source.slots, np.uint8)
                    slots[: len(own)] = np.maximum(slots[: len(own)], own)
            usable = slots[0 if universes else first :]
            universes.append(usable[: len(usable) // width * width])
        lamps = np.concatenate(universes)[: count * width].reshape(count, width)
        levels = [round(257 * level) for level in lamps.mean(axis=1)]
        if levels != self._shown:
            self._shown = levels
            self._lamps.show(levels)


def _acn(packet: bytes) -> tuple[int, int, int, bytes] | None:
    """Universe, priority, sequence and slots of an E1.31 data packet with start code 0; no slots
    where it ends the stream."""
    vectors = packet[18:22] + packet[40:44] + packet[117:119]
    if packet[:16] != _ACN or vectors != bytes([0, 0, 0, 4, 0, 0, 0, 2, 2, 0xA1]):
        return None
    count = int.from_bytes(packet[123:125], "big")
    flags = [int.from_bytes(packet[at : at + 2], "big") - 0x7000 + at for at in (16, 38, 115)]
    whole = flags == [len(packet)] * 3 and count == len(packet) - 125
    if not whole or packet[119:123] != b"\0\0\0\1" or packet[125] != 0:
        return None
    slots = b"" if packet[112] & 0x40 else packet[126:]
    return int.from_bytes(packet[113:115], "big"), packet[108], packet[111], slots


def _art(packet: bytes) -> tuple[int, int, int, bytes] | None:
    """As `_acn`, of an ArtDmx packet; its priority is 0."""
    size = int.from_bytes(packet[16:18], "big")
    if packet[:12] != b"Art-Net\0\x00\x50\0\x0e" or size % 2 or len(packet) != 18 + size:
        return None
    return int.from_bytes(packet[14:16], "little"), 0, packet[12], packet[18:]


def _poll_reply(port: int, fail_safe: int) -> bytes:
    """An ArtPollReply; `fail_safe`: 0 hold, 1 zero, 2 full, 3 scene."""
    reply = bytearray(239)
    reply[:10] = b"Art-Net\0\x00\x21"
    reply[10:16] = socket.inet_aton(HOST) + port.to_bytes(2, "little")
    reply[26:35] = b"simulated"
    reply[217] = fail_safe << 6 | 0x20
    return bytes(reply)
