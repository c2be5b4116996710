"""Live session with its page: the source runs in a separate thread, the web server in this one."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import threading
from collections.abc import Callable, Iterator

from edp.live.server import LiveServer
from edp.workflows.live.mirror import RerunMirror
from edp.workflows.live.run_live import LiveOrder, LiveResult, LiveRun
from edp.workflows.live.sources import LiveSource

STOP_S = 5.0
"""Maximum wait for the thread of a source, which may be computing a sample."""


def run_live(
    order: LiveOrder,
    on_ready: Callable[[LiveServer], None] | None = None,
    on_event: Callable[[str, str], None] | None = None,
    source: LiveSource | None = None,
    on_mirror: Callable[[str], None] | None = None,
) -> LiveResult:
    """Serve a session until Ctrl-C, a request to end, an error, or with `LiveOrder.until_end` the end of the source.

    Args:
        order: options of the session.
        on_ready: called once the page can be opened.
        on_event: called with kind and text of each event.
        source: source that replaces the one in `order`.
        on_mirror: called with the address of Rerun's page, where that is asked for.

    Raises:
        EdpError: source, models, port or files cannot be used.
    """
    live = LiveRun(order, on_event, source)
    mirror = _start_mirror(live, on_mirror)
    playing = threading.Thread(target=live.play, name="edp-live-source", daemon=True)
    try:
        asyncio.run(_serve(live, playing, on_ready))
    finally:
        live.pace.stop()
        if playing.ident is not None:
            playing.join(STOP_S)
        if mirror is not None:
            mirror.close()
        result = live.close()
    if live.failure is not None:
        raise live.failure
    return result


def _start_mirror(live: LiveRun, on_mirror: Callable[[str], None] | None) -> RerunMirror | None:
    if not live.order.rerun:
        return None
    try:
        mirror = RerunMirror(live.session)
    except BaseException:
        live.close()
        raise
    if on_mirror is not None:
        on_mirror(mirror.address)
    return mirror


async def _serve(live: LiveRun, playing: threading.Thread, on_ready: Callable[[LiveServer], None] | None) -> None:
    stop, order = asyncio.Event(), live.order
    server = LiveServer(live.session, live.pace if live.source.steered else None, order.host, order.port)

    def ready(one: LiveServer) -> None:
        if on_ready is not None:
            on_ready(one)
        # Once the port is open: a port in use is refused before anything is played or recorded.
        playing.start()

    async def watch_end() -> None:
        while not stop.is_set():
            await asyncio.sleep(0.1)
            ended = playing.ident is not None and not playing.is_alive()
            if ended and (order.until_end or live.failure is not None):
                stop.set()

    with _interrupts(stop):
        ending = asyncio.create_task(watch_end())
        try:
            await server.run(stop, ready)
        finally:
            ending.cancel()


@contextlib.contextmanager
def _interrupts(stop: asyncio.Event) -> Iterator[None]:
    """End the session on Ctrl-C or a termination request, and complete its files; only in the main thread."""
    loop = asyncio.get_running_loop()
    signals = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    handlers_before = {number: signal.getsignal(number) for number in signals}
    for number in signals:
        try:
            loop.add_signal_handler(number, stop.set)
        except NotImplementedError:  # the loops of Windows, which a plain handler has to wake
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(stop.set))
    try:
        yield
    finally:
        for number in signals:
            with contextlib.suppress(NotImplementedError):
                loop.remove_signal_handler(number)
            # None: a handler that is not Python's cannot be set again.
            signal.signal(number, handlers_before[number] or signal.SIG_DFL)
