"""What the listener does with connections, whatever comes over them."""

from __future__ import annotations

import asyncio
import socket

from stage_service.api.app import listening


def test_answers_leave_at_once():
    """Without TCP_NODELAY the second of two small writes waits 40 ms for an acknowledgement."""

    async def accepted() -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def take(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connection = writer.get_extra_info("socket")
            found.set_result(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(take, sock=listening(0)) as server:
            _, client = await asyncio.open_connection(*server.sockets[0].getsockname())
            delay_off = await found
            client.close()
            return delay_off

    assert asyncio.run(accepted()) == 1
