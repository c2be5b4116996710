"""Page of a session: live from a server, or one file that replays the streamed data."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path

from markupsafe import Markup

from edp.live.session import LiveSession
from edp.report.common.templates import asset, json_text, stylesheet, template
from edp.storage import write_bytes

SAVED_BYTES = 24 << 20
"""Maximum size of the rows in a saved page, bytes: the newest 17 minutes of 60 columns at 100 Hz. The page is a third
larger.
"""
_SCRIPTS = ("uplot/uPlot.iife.min.js", "side_view.js", "live_store.js", "live_charts.js", "live.js")
_STYLES = ("uplot/uPlot.min.css", "live.css")


def live_page(title: str, host: str) -> tuple[str, str]:
    """Return the page of a server with its content security policy.

    Args:
        title: title of the page.
        host: address and port under which the page was asked for, checked.
    """
    script, style = parts()
    connect = f"ws://{host}"
    policy = "; ".join(
        [
            "default-src 'none'",
            # Hashes, not 'unsafe-inline': nothing that a name smuggles in could run.
            f"script-src '{_hash(script)}'",
            f"style-src '{_hash(style)}'",
            f"connect-src {connect}",
            "img-src data: blob:",
            "form-action 'none'",
            "base-uri 'none'",
            "frame-ancestors 'none'",
        ]
    )
    return _render_page(title, connect, {"mode": "live"}), policy


def session_page(session: LiveSession) -> str:
    """Return the data streamed so far as a page without a server, limited to the latest `SAVED_BYTES` of rows."""
    most = max(1, SAVED_BYTES // (4 * session.layout.width))
    first, rows = session.read(session.ticks - most, most)
    content = {
        "mode": "saved",
        "layout": session.layout.to_dict(),
        "first": first,
        "count": len(rows),
        "all": session.ticks,
        "rows": base64.b64encode(rows.astype("<f4").tobytes()).decode(),
        "events": [event.to_dict() for event in session.events()],
        "ended": session.ended,
        "breaks": session.breaks,
    }
    return _render_page(session.layout.title, "'none'", content)


def write_session_page(session: LiveSession, target: str | Path) -> Path:
    """Write `session_page`.

    Raises:
        StorageError: the page cannot be written.
    """
    write_bytes(Path(target), session_page(session).encode("utf-8", "replace"))
    return Path(target)


@cache
def parts() -> tuple[str, str]:
    """Return the script and style of the page."""
    return "\n".join(map(asset, _SCRIPTS)), stylesheet(*_STYLES)


def _render_page(title: str, connect: str, content: dict[str, object]) -> str:
    script, style = parts()
    return template("live.html.jinja").render(
        title=title, connect=connect, style=Markup(style), script=Markup(script), data=json_text(content)
    )


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
