"""The server of a live session: one page and its socket, for those who have the address."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import math
import secrets
import socket
from collections.abc import Callable
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response

from edp.errors import ConfigError, DataError
from edp.live.addresses import LOOPBACK, resolve_bind
from edp.live.pace import Pace
from edp.live.protocol import MAX_PAST, MAX_REQUEST, PAST, ROWS, Request, request_of, rows_message, text_message
from edp.live.saved import live_page, session_page
from edp.live.session import LiveSession
from edp.live.viewer import SEND_BUFFER, Viewer

FLUSH_S = 0.04
"""Interval between messages with rows, s: 25 pictures per second."""
STATE_S = 1.0
MAX_ROWS = 3000
"""Maximum number of rows per message. A faster source omits rows, and the page shows their number."""
BACKLOG_S = 30.0
"""Duration of the history that a new viewer receives, s."""
MAX_AHEAD_S = 600.0
MAX_VIEWERS = 32
MAX_BREAKS = 50
"""Maximum number of restarts of the time axis that are reported to a page."""
TOKEN_BYTES = 24
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    # The address holds the token: no other server may learn it.
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class LiveServer:
    """Page and socket of one session.

    Args:
        session: session to display.
        pace: clock of the source; None if viewers cannot control it.
        host: address to listen on; loopback unless told otherwise.
        port: 0 for a free one.

    Attributes:
        token: token required by page and socket.
        port: once it listens.
        bind: address that `host` stands for.
        viewers: connected viewers.
        skipped: rows that were sent to nobody, since the source ran ahead.
    """

    def __init__(self, session: LiveSession, pace: Pace | None, host: str = LOOPBACK, port: int = 0) -> None:
        self.session, self.pace, self.host, self.port = session, pace, host, port
        self.bind = resolve_bind(host, "--bind")
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self.viewers: set[Viewer] = set()
        self.skipped = 0
        self._sent, self._told = 0, 0

    @property
    def address(self) -> str:
        """Address of the page, including the token."""
        # An address that stands for all of a machine's is none to type into a browser.
        host = socket.gethostname() if self.bind.is_everywhere else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self.token}/"

    async def run(self, stop: asyncio.Event, on_ready: Callable[[LiveServer], None] | None = None) -> None:
        """Serve until stopped.

        Args:
            stop: set to end.
            on_ready: called once the port is open.

        Raises:
            ConfigError: the port is in use, or the address is none of this machine.
        """
        logger = logging.getLogger("edp.live.websockets")
        # A browser that leaves is no news; the library would log each one to standard error.
        logger.propagate, logger.disabled = False, True
        try:
            server = await serve(
                self._serve_viewer,
                self.host,
                self.port,
                process_request=self._answer,
                compression=None,
                max_size=MAX_REQUEST,
                max_queue=8,
                write_limit=SEND_BUFFER,
                open_timeout=5.0,
                close_timeout=1.0,
                server_header=None,
                logger=logger,
            )
        except OSError as error:
            raise ConfigError(
                f"the live view cannot listen on {self.host}, port {self.port}: {error.strerror or error}; choose "
                "another --port (0 takes a free one), or another --bind"
            ) from error
        async with server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            if on_ready is not None:
                on_ready(self)
            await self._broadcast(stop)

    async def _broadcast(self, stop: asyncio.Event) -> None:
        """Send new data to viewers at a steady rate, through one queue each."""
        loop = asyncio.get_running_loop()
        state_due = 0.0
        while not stop.is_set():
            self._offer_rows()
            events = self.session.events(self._told)
            self._told = self.session.event_count
            for event in events:
                self._tell(text_message("event", event=event.to_dict()))
            if loop.time() >= state_due:
                self._tell(self._state())
                state_due = loop.time() + STATE_S
            try:
                await asyncio.wait_for(stop.wait(), FLUSH_S)
            except TimeoutError:
                continue
        # What came last, with the reason of the end.
        self._offer_rows()
        for event in self.session.events(self._told):
            self._tell(text_message("event", event=event.to_dict()))
        self._tell(self._state())
        self._tell(text_message("closed"))
        await asyncio.sleep(FLUSH_S)

    def _offer_rows(self) -> None:
        session = self.session
        waiting = session.ticks - self._sent
        if waiting <= 0:
            return
        self.skipped += max(0, waiting - MAX_ROWS)
        first, rows = session.read(session.ticks - min(waiting, MAX_ROWS), MAX_ROWS)
        self._sent = first + len(rows)
        if self.viewers:
            message = rows_message(ROWS, first, rows, session.stamp)
            for viewer in self.viewers:
                viewer.offer(message, len(rows))

    def _tell(self, text: str) -> None:
        for viewer in self.viewers:
            viewer.tell(text)

    def _state(self) -> str:
        session, pace = self.session, self.pace
        speed = None if pace is None or math.isinf(pace.speed) else pace.speed
        return text_message(
            "state",
            ticks=session.ticks,
            oldest=session.oldest,
            ended=session.ended,
            paused=pace is not None and pace.paused,
            speed=speed,
            late=pace is not None and pace.is_late(session.ticks),
            preparing=session.preparing if session.ticks == 0 else "",
            skipped=self.skipped,
            viewers=len(self.viewers),
            breaks=session.breaks[-MAX_BREAKS:],
        )

    async def _answer(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """Return the page, saved session or a refusal; None lets a socket open."""
        host = request.headers.get("Host", "")
        if not self._ours(host):
            return _text(HTTPStatus.MISDIRECTED_REQUEST, "this address is not the one that edp live printed")
        _, token, *rest = (*urlsplit(request.path).path.split("/", 2), "")
        if not hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode()):
            return _text(
                HTTPStatus.FORBIDDEN,
                "the token in the address is wrong or missing; open the address that edp live printed",
            )
        what = rest[0]
        if what == "socket":
            # A page of another server may open sockets to this one; its origin gives it away.
            if request.headers.get("Origin") != f"http://{host}":
                return _text(HTTPStatus.FORBIDDEN, "the live view takes viewers from its own page only")
            if len(self.viewers) >= MAX_VIEWERS:
                return _text(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} viewers are connected; close one")
            return None
        if what == "":
            page, policy = live_page(self.session.layout.title, host)
            return _page(page, {"Content-Security-Policy": policy})
        if what == "session.html":
            page = await asyncio.to_thread(session_page, self.session)
            return _page(page, {"Content-Disposition": 'attachment; filename="session.html"'})
        return _text(HTTPStatus.NOT_FOUND, "there is no such page")

    def _ours(self, host: str) -> bool:
        """Return whether a request came under an address of this server, not under a name that someone points here."""
        try:
            parts = urlsplit(f"//{host}")
            name, port = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if port != self.port:
            return False
        if name in ("localhost", self.host, socket.gethostname().lower()):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not self.bind.is_loopback

    async def _serve_viewer(self, connection: ServerConnection) -> None:
        """Serve one viewer, from its first message to its end."""
        viewer = Viewer(connection)
        session = self.session
        backlog = min(round(BACKLOG_S * session.layout.rate_hz), MAX_PAST)
        self.viewers.add(viewer)
        viewer.tell(text_message("layout", layout=session.layout.to_dict(), steered=self.pace is not None))
        for event in session.events():
            viewer.tell(text_message("event", event=event.to_dict()))
        viewer.tell(self._state())
        oldest = max(0, self._sent - backlog)
        first, rows = session.read(oldest, self._sent - oldest)
        if len(rows):
            viewer.offer(rows_message(PAST, first, rows, session.stamp), 0)
        sending = asyncio.create_task(viewer.send())
        try:
            async for message in connection:
                self._obey(viewer, message)
        except ConnectionClosed:
            pass
        finally:
            self.viewers.discard(viewer)
            sending.cancel()

    def _obey(self, viewer: Viewer, message: str | bytes) -> None:
        """Execute a viewer's request, or send the reason for a refusal."""
        if not viewer.may_ask():
            return
        try:
            self._do(viewer, request_of(message))
        except (DataError, ConfigError) as error:
            viewer.tell(text_message("refused", text=str(error)))
        if self.pace is not None:
            self._tell(self._state())

    def _do(self, viewer: Viewer, request: Request) -> None:
        if request.name == "past":
            first, count = (int(number) for number in request.numbers)
            start, rows = self.session.read(max(first, 0), min(max(count, 0), MAX_PAST))
            viewer.offer(rows_message(PAST, start, rows, self.session.stamp), 0)
        elif self.pace is None:
            raise DataError("this source runs by itself: nobody can pause it or change its speed")
        elif request.name == "pause":
            self.pace.pause(request.numbers[0] != 0.0)
        elif request.name == "speed":
            self.pace.set_speed(request.numbers[0])
        else:
            # Of a source without an end a viewer may skip some minutes, not send it off for good.
            most = self.session.layout.ticks or self.session.ticks + round(MAX_AHEAD_S * self.session.layout.rate_hz)
            self.pace.run_ahead(min(int(request.numbers[0]), most))


def _page(text: str, headers: dict[str, str]) -> Response:
    return _response(HTTPStatus.OK, "text/html; charset=utf-8", text, headers)


def _text(status: HTTPStatus, text: str) -> Response:
    return _response(status, "text/plain; charset=utf-8", text + "\n", {})


def _response(status: HTTPStatus, kind: str, text: str, headers: dict[str, str]) -> Response:
    body = text.encode("utf-8", "replace")
    every = {**HEADERS, "Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close", **headers}
    return Response(status.value, status.phrase, Headers(every), body)
