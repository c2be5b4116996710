"""The page in a headless Chromium: what it shows, what it does not fetch, and that names in it are text."""

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from browser import DESK, Browser, check_kind, page_faults, serious_findings

from edp.live import Forecast, LiveLayout, LiveSession, LiveTrace, Pace, write_session_page
from edp.live.server import LiveServer
from edp.report.animation.page import geometry_of
from edp.signals import Channel, Kind
from edp.sim import load_machine

pytestmark = pytest.mark.processes
HOSTILE = "<img src=x onerror=\"document.title='owned'\">"


def session_of(steered: bool = True) -> LiveSession:
    names = (HOSTILE, "</script><script>document.title='owned'</script>", "Lever_1")
    traces = [LiveTrace.from_channel(Channel(name, Kind.VELOCITY, name)) for name in names]
    forecast = Forecast(HOSTILE, "mm/s", 1e3, 10, 3, 4, 5, 0.9, 0)
    layout = LiveLayout(
        HOSTILE, HOSTILE, 100.0, 10, traces, [forecast], geometry_of(load_machine("M22")), (6, 7, 8), (2,),
        {HOSTILE: 9}, steered, 5000,
    )  # fmt: skip
    return LiveSession(layout)


def stream(session: LiveSession, ticks: int) -> None:
    for _ in range(ticks):
        t = session.ticks / 100.0
        wave = np.sin(t)
        row = [wave, 0.1, 0.5, wave, wave - 0.2, wave + 0.2, 0.6 + 0.1 * wave, -1.5, -0.5 + 0.3 * wave, 0.3]
        session.append(np.array(row, np.float32))


@contextmanager
def serving(server: LiveServer) -> Iterator[None]:
    ready, started = threading.Event(), {}

    async def run() -> None:
        started["loop"], started["stop"] = asyncio.get_running_loop(), asyncio.Event()
        await server.run(started["stop"], lambda one: ready.set())

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    assert ready.wait(20)
    yield
    started["loop"].call_soon_threadsafe(started["stop"].set)
    thread.join(20)


@pytest.fixture
def served() -> Iterator[LiveServer]:
    server = LiveServer(session_of(), Pace(100.0))
    with serving(server):
        yield server


def harmless(page: Browser, address: str) -> None:
    """Nothing ran, nothing failed, nothing was fetched from elsewhere."""
    assert page.run("document.title").endswith("live view")
    assert page.run("document.querySelectorAll('img').length") == 0
    assert page.complaints() == []
    assert [one for one in page.requests() if not one.startswith(address)] == []


def test_a_session_is_shown_as_it_comes_and_names_are_text(browser, served):
    session = served.session
    stream(session, 200)
    session.event("alarm", HOSTILE, "g")
    session.event("alarm", HOSTILE, "g")
    page = browser
    page.open(served.address)
    page.wait("window.edpLive && edpLive.frames > 0 && document.querySelectorAll('#events li').length")
    stream(session, 300)
    page.wait("edpLive.ticks >= 300 && document.getElementById('clock').textContent.startsWith('5.0 s')")
    assert page.run("document.getElementById('title').textContent") == HOSTILE
    assert HOSTILE in page.run("document.getElementById('charts').textContent")
    assert page.run("document.querySelectorAll('#charts figure').length") == 3
    # Alarms that say the same are one row, with their number.
    assert page.run("document.querySelectorAll('#events li.alarm').length") == 1
    assert "(2 times" in page.run("document.querySelector('#events li.alarm').textContent")
    assert page.run("document.getElementById('front').width") > 100
    assert page.run("document.documentElement.scrollWidth <= innerWidth")
    harmless(page, served.address)
    assert serious_findings(page) == []
    page.size(390, 844, phone=True)
    page.wait("document.documentElement.scrollWidth <= innerWidth")
    page.size(*DESK, dark=True)
    assert page.run("getComputedStyle(document.body).backgroundColor") == "rgb(20, 25, 30)"
    stream(session, 10)
    # The line of what is measured is light on dark now.
    page.wait("document.querySelector('figcaption i[data-colour=measured]').style.borderColor === 'rgb(232, 236, 240)'")
    assert serious_findings(page) == []


def test_viewers_pause_look_back_and_run_ahead(browser, served):
    stream(served.session, 400)
    page = browser
    page.open(served.address)
    page.wait("window.edpLive && edpLive.frames > 0 && edpLive.state")
    page.run("document.getElementById('play').click()")
    page.wait("document.getElementById('state').textContent.startsWith('source paused')")
    assert served.pace.paused
    page.run("document.getElementById('play').click()")
    page.wait("document.getElementById('play').textContent === 'Pause'")
    seek = (
        "(() => {{ const s = document.getElementById('scrub'); s.value = {}; s.dispatchEvent(new Event('input')); }})()"
    )
    page.run(seek.format(100))
    page.wait("document.getElementById('clock').textContent.startsWith('1.0 s')")
    stream(served.session, 50)
    time.sleep(0.3)
    assert page.run("document.getElementById('clock').textContent").startswith("1.0 s")
    page.run(seek.format(3000))
    page.wait("document.getElementById('clock').textContent.startsWith('4.5 s')")
    assert served.pace._ahead == 3000
    harmless(page, served.address)


def test_a_server_that_ends_and_rows_that_stop_are_said(browser, served):
    stream(served.session, 100)
    page = browser
    page.open(served.address)
    page.wait("window.edpLive && edpLive.frames > 0")
    stream(served.session, 10)
    page.wait("document.getElementById('state').textContent.startsWith('no new values for')")
    served.session.end("the log has ended after 1 s")
    page.wait("document.getElementById('state').textContent.startsWith('the log has ended')")


def test_a_saved_session_replays_without_a_server(browser, tmp_path: Path):
    session = session_of()
    stream(session, 450)
    session.break_off()
    stream(session, 50)
    session.event("alarm", HOSTILE)
    session.end("done")
    file = write_session_page(session, tmp_path / "session.html")
    page = browser
    page.open(file, (1280, 1400))
    page.wait("window.edpLive && edpLive.frames > 3")
    page.wait("parseFloat(document.getElementById('clock').textContent) > 0.3")
    assert page.run("document.getElementById('events').textContent").count(HOSTILE) == 1
    page.run("document.getElementById('speed').value = '50'")
    page.wait("document.getElementById('play').textContent === 'Play'")
    page.wait("document.getElementById('clock').textContent.startsWith('5.0 s')")
    scrub = "const s = document.getElementById('scrub')"
    residual = "[...document.querySelectorAll('figcaption span span')].pop().textContent"
    for tick, shown in ((449, True), (451, False), (459, False), (461, True)):
        page.run(f"(() => {{ {scrub}; s.value = {tick}; s.dispatchEvent(new Event('input')); }})()")
        page.wait(f"document.getElementById('clock').textContent.startsWith('{tick / 100:.1f} s')")
        # Nothing foretold of the session before is held against the one that began anew.
        page.wait(f"({residual} !== '–') === {str(shown).lower()}")
    harmless(page, file.as_uri())


WIDTHS = (1280, 1366, 1440, 1920, 390)


def test_plots_do_not_overlap_at_any_width(browser, served, tmp_path):
    session = served.session
    stream(session, 600)
    session.event("note", "a note")
    session.end("done")
    for address in (served.address, write_session_page(session, tmp_path / "session.html")):
        for width in WIDTHS:
            browser.open(address, (width, 900), phone=width < 500)
            browser.wait("window.edpLive && edpLive.frames > 0 && document.querySelectorAll('.u-wrap').length > 2")
            for dark in (False, True):
                browser.size(width, 900, width < 500, dark)
                assert page_faults(browser) == [], (address, width, dark)
        check_kind(browser, "live view")
        # Plots follow their figures when others come and go.
        browser.size(1366, 900)
        for _ in range(2):
            browser.run("document.querySelector('#boxes input').click()")
            assert page_faults(browser) == []


def test_a_page_without_rows_says_what_it_waits_for(browser):
    session = session_of()
    session.preparing = "compiling"
    server = LiveServer(session, Pace(100.0))
    with serving(server):
        browser.open(server.address)
        browser.wait("document.getElementById('state').textContent.startsWith('compiling')")
        session.preparing = ""
        browser.wait("document.getElementById('state').textContent.startsWith('waiting for the first values')")
        stream(session, 10)
        browser.wait("document.getElementById('state').textContent.startsWith('live')")


def test_a_source_that_is_late_is_told_as_long_as_it_is(browser):
    clock = [0.0]
    pace = Pace(100.0, clock=lambda: clock[0])
    server = LiveServer(session_of(), pace)
    with serving(server):
        browser.open(server.address)
        pace.wait(0)
        clock[0] = 5.0
        pace.wait(1)
        stream(server.session, 10)
        browser.wait("document.getElementById('notice').textContent.includes('behind real time')")
        stream(server.session, 1100)
        browser.wait("document.getElementById('notice').hidden")
