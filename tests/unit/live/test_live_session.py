"""What a session keeps, when ticks are due, what a page may ask for."""

import json
import math
import threading

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.live import LiveLayout, LiveSession, LiveTrace, Pace, write_session_page
from edp.live.layout import MOST_LABEL, label, sentence
from edp.live.protocol import HEAD, PAST, request_of, rows_message, text_message
from edp.live.saved import session_page
from edp.live.session import MAX_EVENTS, MOST_TEXT
from edp.signals import Channel, Kind


def layout_of(width: int = 2, ticks: int | None = None, **changes) -> LiveLayout:
    traces = [LiveTrace.from_channel(Channel(f"c{n}", Kind.VELOCITY)) for n in range(width)]
    return LiveLayout("title", "source", 100.0, width, traces, ticks=ticks, **changes)


def filled(ticks: int, history_bytes: int = 8 * 100) -> LiveSession:
    session = LiveSession(layout_of(), history_bytes)
    for tick in range(ticks):
        session.append(np.array([tick, -tick], np.float32))
    return session


def test_a_ring_keeps_the_newest_rows_and_says_which():
    session = filled(250)
    assert (session.ticks, session.oldest) == (250, 150)
    first, rows = session.read(0, 1000)
    assert first == 150
    assert rows[:, 0].tolist() == list(range(150, 250))
    first, rows = session.read(200, 10)
    assert (first, rows[:, 1].tolist()) == (200, [-float(n) for n in range(200, 210)])
    assert len(session.read(250, 5)[1]) == len(session.read(9999, 5)[1]) == len(session.read(180, -5)[1]) == 0
    with pytest.raises(DataError, match=r"shape \(3,\)"):
        session.append(np.zeros(3, np.float32))


def test_events_are_bounded_and_numbered_on():
    session = filled(3)
    for n in range(MAX_EVENTS + 10):
        session.event("note", f"{n} " + "x" * 1000, "g" * 1000)
    events = session.events()
    assert len(events) == MAX_EVENTS
    assert events[-1].number == MAX_EVENTS + 9
    assert events[0].tick == 3
    assert max(len(event.text) for event in events) == MOST_TEXT
    assert [event.number for event in session.events(MAX_EVENTS + 8)] == [MAX_EVENTS + 8, MAX_EVENTS + 9]


def test_rows_are_written_and_read_at_the_same_time():
    session = LiveSession(layout_of(), 8 * 64)
    torn = []

    def look() -> None:
        while not session.ended:
            first, rows = session.read(session.ticks - 50, 50)
            if rows[:, 0].tolist() != list(range(first, first + len(rows))) or rows.sum():
                torn.append(first)

    reader = threading.Thread(target=look)
    reader.start()
    for tick in range(20_000):
        session.append(np.array([tick, -tick], np.float32))
    session.end("done")
    reader.join()
    assert torn == []


class Hand:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_ticks_are_due_at_their_time_and_lost_time_is_given_up():
    clock = Hand()
    pace = Pace(100.0, 2.0, clock)
    assert pace.wait(0)
    clock.now = 0.05  # ten ticks at twice the rate
    assert all(pace.wait(tick) for tick in range(1, 11))
    clock.now = 5.0
    assert pace.wait(11)
    assert pace.late == 1
    # It does not race after the lost time: the next one is due a tick later.
    released = threading.Event()
    waiting = threading.Thread(target=lambda: (pace.wait(12), pace.wait(13), pace.wait(40), released.set()))
    waiting.start()
    assert not released.wait(0.05)
    pace.run_ahead(1000)
    waiting.join(5)
    assert released.is_set()


def test_a_paused_source_waits_and_an_ended_one_does_not():
    pace = Pace(100.0, math.inf)
    assert pace.wait(0)
    pace.pause(True)
    results = []
    waiting = threading.Thread(target=lambda: results.append(pace.wait(1)))
    waiting.start()
    waiting.join(0.05)
    assert waiting.is_alive()
    pace.pause(False)
    waiting.join(5)
    assert results == [True]
    pace.stop()
    assert not pace.wait(2)


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, 1e9, -math.inf])
def test_a_speed_that_is_none_is_refused(speed):
    with pytest.raises(ConfigError, match="times real time"):
        Pace(100.0, speed)


def test_a_page_may_ask_four_things_and_nothing_else():
    assert request_of('{"do":"past","first":5,"count":7}').numbers == (5.0, 7.0)
    assert request_of('{"do":"pause","value":1}').name == "pause"
    for text in (
        b"\0" * 10, "x" * 300, "[]", "{}", '{"do":"stop"}', '{"do":["past"]}', '{"do":"speed","value":NaN}', '"past"',
        '{"do":"speed","value":1e400}', '{"do":"past","first":1}', '{"do":"past","first":[],"count":2}', "[" * 250,
        '{"do":"ahead","tick":1e300}', '{"do":"__class__","value":1}',
    ):  # fmt: skip
        with pytest.raises(DataError):
            request_of(text)


def test_messages_hold_what_went_in():
    rows = np.arange(6, dtype=np.float32).reshape(3, 2)
    message = rows_message(PAST, 41, rows, 123.5)
    assert HEAD.unpack_from(message) == (PAST, 41, 3, 2, 123.5)
    assert np.frombuffer(message[HEAD.size :], "<f4").tolist() == rows.ravel().tolist()
    with pytest.raises(ValueError, match="JSON compliant"):
        text_message("x", value=math.nan)


def test_names_are_bounded_text():
    assert label("a" * 250 + "b" * 250) == "a" * (MOST_LABEL - 32) + "…" + "b" * 31
    assert (
        label("x\u202ey\x1b[2J\n") == "x\N{REPLACEMENT CHARACTER}y\N{REPLACEMENT CHARACTER}[2J\N{REPLACEMENT CHARACTER}"
    )
    assert sentence("grün <b>") == "grün <b>"
    plain = layout_of(statistics={"s" * 200: 1}).to_dict()
    assert len(plain["statistics"][0]["name"]) == MOST_LABEL


def test_a_saved_page_is_bounded_and_holds_the_newest_rows(tmp_path, monkeypatch):
    session = filled(90, 8 * 1000)
    session.event("alarm", "</script><script>alert(1)</script>")
    whole = session_page(session)
    monkeypatch.setattr("edp.live.saved.SAVED_BYTES", 8 * 50)
    page = write_session_page(session, tmp_path / "s.html").read_text(encoding="utf-8")
    assert len(page) < len(whole)
    start = page.index('id="session">') + len('id="session">')
    content = json.loads(page[start : page.index("</script>", start)])
    assert (content["first"], content["count"], content["all"]) == (40, 50, 90)
    assert content["events"][0]["text"] == "</script><script>alert(1)</script>"
    assert "<script>alert" not in page
    assert "https://" not in page.replace("/*! https://github.com/leeoniya/uPlot", "")
