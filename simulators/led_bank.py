"""The light bank's side of Modbus TCP (docs/wire.md), on pymodbus' server."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from simulators.lamps import Lamps

UNIT = 1
SELECTOR, HEARTBEAT, WATCHDOG = 1000, 1001, 1002
FIXED = 0x4853
_MOST_COILS = 1968
_READ_INPUT = 4
_COIL_FUNCTIONS, _HOLDING_FUNCTIONS = (1, 5, 15), (3, 6, 16, 22, 23)


class LedBank:
    """Serves `lamps` on a thread of its own, which runs the server's event loop.

    `hanging()` says whether the bank has stopped to answer. Start with `start`, end with `stop`.
    """

    def __init__(
        self,
        lamps: Lamps,
        host: str,
        port: int,
        hanging: Callable[[], bool] = lambda: False,
    ) -> None:
        self._lamps = lamps
        self._address = (host, port)
        self._hanging = hanging
        self._loop = asyncio.new_event_loop()
        self._server: ModbusTcpServer | None = None
        self._thread = threading.Thread(target=self._run, name="led bank", daemon=True)

    def start(self) -> int:
        """Listen and return the port. Raises `OSError` when the address is taken."""
        self._thread.start()
        return asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result()

    def stop(self) -> None:
        """Close the server and every connection."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()

    async def _listen(self) -> int:
        # The server logs what it then raises, and every refused request.
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
        self._server = ModbusTcpServer(self._device(), address=self._address)
        await self._listen_or_raise(self._server)
        transport = self._server.transport
        assert isinstance(transport, asyncio.Server)
        return int(transport.sockets[0].getsockname()[1])

    async def _listen_or_raise(self, server: ModbusTcpServer) -> None:
        try:
            await server.serve_forever(background=True)
        except RuntimeError as error:
            host, port = self._address
            raise OSError(f"light bank: cannot listen on {host}:{port}: {error}") from error

    async def _close(self) -> None:
        if self._server is not None:
            await self._server.shutdown()  # type: ignore[no-untyped-call]
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    def _device(self) -> SimDevice:
        """The address map; its registers are copies that every read refreshes from the lamps."""
        n = self._lamps.count
        coils = [SimData(0, values=[False] * n, datatype=DataType.BITS)]
        unused = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
        holding = [
            SimData(0, count=n, datatype=DataType.REGISTERS),
            SimData(SELECTOR, count=3, datatype=DataType.REGISTERS),
        ]
        inputs = [SimData(0, count=4, datatype=DataType.REGISTERS)]
        return SimDevice(UNIT, simdata=(coils, unused, holding, inputs), action=self._access)

    async def _access(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Called by pymodbus before each access: carry out a write, or refresh for a read."""
        while self._hanging():
            await asyncio.sleep(0.05)
        if values is None:
            self._refresh(function, start, registers)
            return None
        if function in _COIL_FUNCTIONS:
            return self._write_coils(address, [bool(v) for v in values])
        return self._write_holding(address, [int(v) for v in values])

    def _refresh(self, function: int, start: int, registers: list[int]) -> None:
        if function in _COIL_FUNCTIONS:
            packed = [0] * len(registers)
            for i, on in enumerate(self._lamps.coils()):
                packed[i // 16 - start] |= on << i % 16
            registers[:] = packed
        elif function in _HOLDING_FUNCTIONS:
            registers[: self._lamps.count] = self._lamps.levels()
            registers[SELECTOR : WATCHDOG + 1] = self._lamps.control()
        elif function == _READ_INPUT:
            registers[:4] = [*self._lamps.status(), self._lamps.count, FIXED]

    def _write_coils(self, address: int, on: list[bool]) -> ExcCodes | None:
        if address + len(on) > self._lamps.count:
            return ExcCodes.ILLEGAL_ADDRESS
        if len(on) > _MOST_COILS:
            return ExcCodes.ILLEGAL_VALUE
        self._lamps.switch(address, on)
        return None

    def _write_holding(self, address: int, values: list[int]) -> ExcCodes | None:
        if address < SELECTOR:
            self._lamps.dim(address, values)
            return None
        commands = dict(enumerate(values, address))
        if WATCHDOG in commands and not self._lamps.watch(commands[WATCHDOG]):
            return ExcCodes.ILLEGAL_VALUE
        if HEARTBEAT in commands:
            self._lamps.beat(commands[HEARTBEAT])
        if SELECTOR in commands and not self._lamps.select(commands[SELECTOR]):
            return ExcCodes.ILLEGAL_VALUE
        return None
