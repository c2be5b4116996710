"""Viewer of a live session with its own queue: a slow viewer loses frames, the others do not."""

from __future__ import annotations

import asyncio
import socket
from collections import deque

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from edp.live.protocol import text_message

SEND_BUFFER = 1 << 16
"""Size of the socket's send buffer, bytes. A larger buffer would delay the display of a slow viewer by seconds."""
MAX_WAITING = 50
"""Maximum number of waiting messages with rows: two seconds."""
MAX_TEXTS = 1000
"""Maximum number of other waiting messages. A viewer with more waiting messages counts as disconnected."""
REQUESTS_PER_S = 30.0


class Viewer:
    """A connection, and what waits for it.

    Attributes:
        dropped: rows that this viewer did not get.
    """

    def __init__(self, connection: ServerConnection) -> None:
        self.dropped = 0
        self._told_dropped = 0
        self._connection = connection
        self._rows: deque[tuple[bytes, int]] = deque()
        self._texts: deque[str] = deque()
        self._ready = asyncio.Event()
        self._budget, self._asked = REQUESTS_PER_S, asyncio.get_running_loop().time()
        tcp = connection.transport.get_extra_info("socket")
        if tcp is not None:
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def offer(self, message: bytes, ticks: int) -> None:
        """Queue rows for the viewer; the oldest rows are dropped if the queue is full."""
        if len(self._rows) >= MAX_WAITING:
            self.dropped += self._rows.popleft()[1]
        self._rows.append((message, ticks))
        self._ready.set()

    def tell(self, text: str) -> None:
        """Queue any other message."""
        if len(self._texts) < MAX_TEXTS:
            self._texts.append(text)
            self._ready.set()

    def may_ask(self) -> bool:
        """Return whether another request is allowed, at most `REQUESTS_PER_S`."""
        now = asyncio.get_running_loop().time()
        self._budget = min(self._budget + (now - self._asked) * REQUESTS_PER_S, REQUESTS_PER_S)
        self._asked = now
        if self._budget < 1.0:
            return False
        self._budget -= 1.0
        return True

    async def send(self) -> None:
        """Send the queued data in order while the connection lasts."""
        try:
            while True:
                await self._ready.wait()
                self._ready.clear()
                while self._texts or self._rows:
                    while self._texts:
                        await self._connection.send(self._texts.popleft())
                    if self.dropped != self._told_dropped:
                        self._told_dropped = self.dropped
                        await self._connection.send(text_message("dropped", ticks=self.dropped))
                    if self._rows:
                        await self._connection.send(self._rows.popleft()[0])
        except ConnectionClosed:
            return
