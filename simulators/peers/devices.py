"""All simulated devices of one rig, started and stopped together."""

from __future__ import annotations

import functools
import json
import os
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from simulators.frames.frames import Sensor
from simulators.peers import dmx_node
from simulators.peers.cameras import CameraLink
from simulators.peers.dmx_widget import DmxWidget
from simulators.peers.faults import Fault
from simulators.peers.lamps import Lamps
from simulators.peers.modbus_rtu import ModbusRtuPeer
from simulators.peers.modbus_tcp import ModbusTcpPeer
from simulators.peers.modbus_unit import DisturbedUnit, ModbusUnit
from simulators.peers.serial_peer import SerialPeer
from simulators.peers.trigger_box import SimulatedTriggerBox
from simulators.world import World
from stage_service.device_config import (
    ArtNetConfig,
    DevicesConfig,
    DmxConfig,
    LightBankConfig,
    LinkCamerasConfig,
    ModbusRtuConfig,
    ModbusTcpConfig,
    SacnConfig,
)

HOST = "127.0.0.1"
DEVICES_FILE = "devices.toml"


@dataclass(eq=False)
class SimulatedStage:
    """The four peers around a `World`; a context manager.

    `configured` is the rig file's `[devices]`; its TCP ports are used, or free ones with
    `free_ports`. Inside the context `devices`, written to `state/devices.toml`, is the `[devices]`
    table with the actual ports and paths. With `paced` a light bank on RTU responds at its baud
    rate.
    """

    world: World
    sensor: Sensor
    state: Path
    configured: DevicesConfig | None = None
    free_ports: bool = True
    paced: bool = False
    devices: dict[str, Any] = field(default_factory=dict, init=False)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._start(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _start(self, stack: ExitStack) -> None:
        self.state.mkdir(parents=True, exist_ok=True)
        world, wires = self.world, self.configured
        fixed = None if self.free_ports else wires
        light_kind = wires.lights if wires else ModbusTcpConfig()
        light_tcp = (HOST, 0)
        if fixed and isinstance(fixed.lights, ModbusTcpConfig):
            light_tcp = (fixed.lights.host, fixed.lights.port)
        if fixed and isinstance(fixed.lights, SacnConfig | ArtNetConfig):
            light_tcp = (dmx_node.HOST, fixed.lights.port)
        camera_host, camera_port = HOST, 0
        if fixed and isinstance(fixed.cameras, LinkCamerasConfig):
            camera_host, camera_port = fixed.cameras.host, fixed.cameras.port
        stack.callback(world.stop)
        link = self.state.absolute() / "lights"
        lights = light_bank(light_kind, world, link, light_tcp, self.paced)
        stack.callback(lights.stop)
        light: dict[str, Any] = {"kind": light_kind.kind, "port": lights.start()}
        if isinstance(light_kind, ModbusTcpConfig):
            light["host"] = light_tcp[0]
        if isinstance(light_kind, SacnConfig | ArtNetConfig):
            light["host"] = dmx_node.HOST
        if isinstance(light_kind, ModbusRtuConfig):
            # a pseudo-terminal has no parity bit; a second stop bit keeps the length of characters
            light |= {"parity": "N", "stop_bits": 2}
        cameras = CameraLink(world, self.sensor, camera_host, camera_port)
        stack.callback(cameras.stop)
        camera_port = cameras.start()
        trigger = SimulatedTriggerBox(world, world.faults)
        stack.callback(trigger.stop)
        serial = {"trigger": trigger.reply, "projectors": world.projectors.reply}
        paths = {}
        for name, reply in serial.items():
            strikes = functools.partial(world.strikes, name)
            peer = SerialPeer(self.state.absolute() / name, reply, strikes)
            peer.start()
            stack.callback(peer.stop)
            paths[name] = str(peer.link)
        self.devices = wires.model_dump(mode="json", exclude_none=True) if wires else {}
        actual: dict[str, dict[str, Any]] = {
            "lights": light,
            "trigger": {"kind": "serial", "port": paths["trigger"]},
            "projectors": {"kind": "serial", "port": paths["projectors"]},
            "cameras": {"kind": "link", "host": camera_host, "port": camera_port},
        }
        for name, table in actual.items():
            base = self.devices.get(name, {})
            self.devices[name] = {**base, **table} if base.get("kind") == table["kind"] else table
        if not world.rig.projectors:
            del self.devices["projectors"]
        file = self.state / DEVICES_FILE
        stack.callback(file.unlink, missing_ok=True)
        ready = file.with_name(f"{file.name}.{os.getpid()}")
        ready.write_text(_toml({"devices": self.devices}))
        ready.replace(file)


class Wired(Protocol):
    """Lamps, active lasting faults, and the fault of a request, see `World`."""

    lamps: Lamps

    def begun(self, device: str, kind: str) -> bool: ...
    def strikes(self, device: str, request: str) -> Fault | None: ...


def light_bank(
    config: LightBankConfig, world: Wired, link: Path, tcp: tuple[str, int], paced: bool = False
) -> DmxWidget | dmx_node.DmxNode | ModbusRtuPeer | ModbusTcpPeer:
    """The peer for `config`: at `tcp` (port 0: a free one), or on a serial port at `link`, with
    `paced` at its baud rate. DMX over a network is at `dmx_node.HOST`."""

    def begun(fault: str) -> bool:
        return world.begun("lights", fault)

    def strikes(request: str) -> Fault | None:
        return world.strikes("lights", request)

    if isinstance(config, DmxConfig):
        first, width = config.first_channel, config.channels
        return DmxWidget(world.lamps, first, link, strikes, begun, width)
    if isinstance(config, SacnConfig | ArtNetConfig):
        return dmx_node.DmxNode(world.lamps, config, tcp[1], strikes, begun)
    unit = DisturbedUnit(ModbusUnit(world.lamps, config.registers, begun), strikes, begun)
    if isinstance(config, ModbusRtuConfig):
        return ModbusRtuPeer(unit, config, link, paced)
    return ModbusTcpPeer(unit, config.unit, *tcp)


def _toml(table: dict[str, Any], path: str = "") -> str:
    """`table` as TOML, for values that JSON and TOML write alike."""
    plain = {k: v for k, v in table.items() if not isinstance(v, dict)}
    text = "".join(f"{k} = {json.dumps(v)}\n" for k, v in plain.items())
    if path and plain:
        text = f"[{path}]\n{text}\n"
    for key, value in table.items():
        if isinstance(value, dict):
            text += _toml(value, f"{path}.{key}" if path else key)
    return text
