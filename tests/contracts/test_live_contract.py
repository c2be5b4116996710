"""Live sources: impossible input never ends a session, an unexpected error ends it with its reason."""

from __future__ import annotations

import inspect
import json
import math
import socket
import sys
import threading
import time
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pytest
import typer
from websockets.sync.client import connect

from edp.cli.console import run_app
from edp.cli.live import LIVE_SOURCES, live
from edp.errors import ConfigError, DataError, EdpError
from edp.live.addresses import resolve_bind
from edp.live.protocol import REQUESTS, request_of
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind
from edp.workflows.live import SOURCES, LiveOrder, LiveRun, SourceOptions, check_options, run_live
from edp.workflows.live.bounded import MAX_MISSED, MAX_VALUE, MIN_VALUE, Repetition, RowBounds, bound_missed
from edp.workflows.live.sources import LiveSource, Needs
from edp.workflows.live.sources.log import LogSource
from edp.workflows.live.sources.udp import UdpSource

pytestmark = pytest.mark.processes
CHANNELS = (TABLE_A1["CylVels_1"], TABLE_A1["CylPressures_1"])
NUMBERS = (0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e-320, 3.5e38, 1e19, 2**63, 10**400)
TIMES = (*NUMBERS, -1e308, 1e12, -5.0, 0.01, 0.01, 0.02, 3600.0, 0.0)


def run_of(source: LiveSource) -> LiveRun:
    return LiveRun(LiveOrder("test", SourceOptions(""), speed=math.inf), source=source)


def text_of(values: dict[str, object]) -> bytes:
    return json.dumps(values).encode()


def hostile_log(monkeypatch) -> LiveRun:
    numbers = [value for value in NUMBERS if not isinstance(value, int)]
    with np.errstate(over="ignore"):
        rows = np.array([[a, b] for a in numbers for b in numbers]).astype(np.float32)
    live_run = run_of(LogSource(Recording("log", CHANNELS, rows, 100.0)))
    live_run.play()
    return live_run


def hostile_udp(monkeypatch) -> LiveRun:
    source = UdpSource(0, 100.0, CHANNELS)
    live_run = run_of(source)
    thread = threading.Thread(target=live_run.play)
    thread.start()
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    datagrams = [text_of({"t": t, "CylVels_1": 0.1}) for t in TIMES]
    datagrams += [text_of({"CylVels_1": value, "x": value}) for value in NUMBERS]
    datagrams += [
        b'{"t":"1"}',
        b'{"t":[[[]]]}',
        b'{"t":{}}',
        b"[" * 9000,
        b'{"a":' * 900,
        b'{"t":1,"t":2}',
        b"",
        b"\xff",
    ]
    for data in datagrams:
        sender.sendto(data, ("127.0.0.1", source.port))
        time.sleep(0.002)
    ends = time.monotonic() + 20.0
    sender.sendto(text_of({"CylVels_1": 0.25}), ("127.0.0.1", source.port))
    while live_run.failure is None and time.monotonic() < ends:
        if live_run.session.ticks and live_run.session.read(live_run.session.ticks - 1, 1)[1][0, 0] == 0.25:
            break
        time.sleep(0.01)
    live_run.pace.stop()
    thread.join(20)
    sender.close()
    source.close()
    return live_run


def hostile_ros2(monkeypatch) -> LiveRun:
    subscriptions: dict[str, Callable[[object], None]] = {}
    node = SimpleNamespace(
        create_subscription=lambda kind, topic, take, qos: subscriptions.update({topic: take}),
        destroy_node=lambda: None,
    )
    rounds = [(t, value, names) for t in TIMES for value in (0.1, math.inf) for names in (["CylVels_1"], ["x"] * 9000)]
    rounds += [(1.0, value, ["CylVels_1"]) for value in (*NUMBERS, "text", None, [1])]
    modules = {name: ModuleType(name) for name in ("rclpy", "rclpy.qos", "sensor_msgs", "sensor_msgs.msg")}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    modules["rclpy"].init, modules["rclpy"].try_shutdown = lambda args: None, lambda: None
    modules["rclpy"].create_node = lambda name: node
    modules["rclpy.qos"].qos_profile_sensor_data = 5
    modules["sensor_msgs.msg"].JointState = modules["sensor_msgs.msg"].FluidPressure = object
    source = SOURCES["ros2"].from_options(SourceOptions("ros2"), Needs(CHANNELS, 100.0))
    live_run = run_of(source)

    def spin_once(node, timeout_sec):
        if not rounds:
            live_run.pace.stop()
            return
        seconds, value, names = rounds.pop(0)
        header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=0), frame_id=f"invented {len(rounds)}")
        subscriptions["pressures"](SimpleNamespace(header=header, fluid_pressure=value))
        joints = SimpleNamespace(header=header, name=names, velocity=[value], position=[], effort=[])
        subscriptions["joint_states"](joints)

    modules["rclpy"].spin_once = spin_once
    live_run.play()
    assert len(source._pressures) == 0  # names that nobody asked for are not kept
    return live_run


def hostile_environment(name: str, value: str, monkeypatch) -> LiveRun:
    source = SOURCES[name].from_options(
        SourceOptions(value, settings={"controller": "pi"} if name == "loop" else {}), Needs()
    )
    live_run, take, numbers = run_of(source), LiveRun.take, [n for n in NUMBERS if not isinstance(n, int)]

    def hostile(self, row, *more, **options):
        if self.session.ticks >= 30:
            self.pace.stop()
        take(
            self,
            np.where(np.arange(len(row)) % 3 == 0, numbers[self.session.ticks % len(numbers)], row.astype(float)),
            *more,
        )

    monkeypatch.setattr(LiveRun, "take", hostile)
    live_run.play()
    return live_run


HOSTILE: dict[str, Callable[[pytest.MonkeyPatch], LiveRun]] = {
    "log": hostile_log,
    "udp": hostile_udp,
    "ros2": hostile_ros2,
    "sim": lambda monkeypatch: hostile_environment("sim", "M22", monkeypatch),
    "loop": lambda monkeypatch: hostile_environment("loop", "point", monkeypatch),
}


def test_every_source_is_attacked_here_and_is_an_option_of_the_command():
    assert set(HOSTILE) == set(SOURCES) == set(LIVE_SOURCES)


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_impossible_numbers_are_missing_and_never_end_a_session(name, monkeypatch):
    live_run = HOSTILE[name](monkeypatch)
    assert live_run.failure is None
    assert live_run.session.ticks > 4
    rows = live_run.session.read(0, live_run.session.ticks)[1][:, : len(live_run.source.channels)]
    size = np.abs(rows[np.isfinite(rows)])
    assert not np.isinf(rows).any()
    assert (size <= MAX_VALUE).all()
    assert ((size == 0.0) | (size >= MIN_VALUE)).all()
    told = [event.text for event in live_run.session.events()]
    assert any("counts as missing" in text or "left out" in text for text in told)


@pytest.mark.parametrize("row", [np.zeros(3), np.array(["a", "b"]), [1j, 2j], None, [[1.0, 2.0]], [True, False]])
def test_a_row_that_is_not_numbers_of_the_channels_is_one_error(row):
    with pytest.raises(DataError, match="expected numbers, shape"):
        RowBounds(CHANNELS).check(row)


@pytest.mark.parametrize(("missed", "taken"), [(0, 0), (7, 7), (-3, 0), (1e308, MAX_MISSED), (math.nan, MAX_MISSED)])
def test_missing_rows_are_counted_within_bounds(missed, taken):
    assert bound_missed(missed) == taken


def test_a_message_that_repeats_does_not_fill_the_page():
    repetition = Repetition()
    assert sum(repetition.is_due("odd", 0) for _ in range(5000)) == 7
    assert all(repetition.is_due("", 0) for _ in range(10))


@pytest.mark.parametrize("name", sorted(REQUESTS))
@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e999", '"1"', "true", "null", "[1]", "{}", "1" * 200, "-1e308"])
def test_what_a_viewer_asks_for_has_numbers_within_bounds(name, value):
    numbers = ",".join(f'"{key}":{value}' for key in REQUESTS[name])
    with pytest.raises(DataError):
        request_of(f'{{"do":"{name}",{numbers}}}')


class Broken(LiveSource):
    """A source with a fault."""

    error: Exception = ValueError("a fault of the source")

    def __init__(self) -> None:
        self.channels, self.rate_hz, self.text = CHANNELS, 100.0, "broken"

    @classmethod
    def from_options(cls, options: SourceOptions, needs: Needs) -> LiveSource:
        return cls()

    def run(self, sink) -> None:
        for _ in range(5):
            sink.take(np.zeros(2))
        raise self.error


ERRORS = [
    ValueError("x"), OverflowError("x"), KeyError("x"), ZeroDivisionError("x"), RecursionError("x"), RuntimeError("x"),
    OSError("x"), TypeError("x"), MemoryError("x"), AssertionError("x"), UnicodeDecodeError("utf-8", b"", 0, 1, "x"),
    DataError("x"),
]  # fmt: skip


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_of_a_source_ends_its_session_and_is_told_to_viewers(error, monkeypatch):
    monkeypatch.setattr(Broken, "error", error)
    monkeypatch.setitem(SOURCES._parts, "broken", Broken)
    events, told, watching = [], [], []

    def look(server) -> None:
        address = f"ws://127.0.0.1:{server.port}/{server.token}/socket"
        with connect(address, origin=f"http://127.0.0.1:{server.port}") as socket_of_page:
            watching.append(True)
            told.extend(json.loads(text) for text in socket_of_page if isinstance(text, str))

    viewer = []

    def ready(server) -> None:
        viewer.append(threading.Thread(target=look, args=(server,)))
        viewer[0].start()

    run = Broken.run

    def run_once_watched(self, sink) -> None:
        ends = time.monotonic() + 20.0
        while not watching and time.monotonic() < ends:
            time.sleep(0.01)
        run(self, sink)

    monkeypatch.setattr(Broken, "run", run_once_watched)
    order = LiveOrder("broken", SourceOptions(""), speed=math.inf)
    with pytest.raises(EdpError) as failure:
        run_live(order, ready, lambda kind, text: events.append(text))
    viewer[0].join(20)
    assert failure.value.exit_code == 1
    assert any("the source has stopped" in text for text in events)
    ended = [message["ended"] for message in told if message["type"] == "state"][-1]
    assert ended.startswith("the source has stopped")
    assert told[-1]["type"] == "closed"
    if not isinstance(error, EdpError):
        assert type(error).__name__ in ended


def test_the_command_ends_with_the_reason_and_exit_code_1(monkeypatch, capsys):
    monkeypatch.setitem(SOURCES._parts, "log", Broken)
    monkeypatch.setattr(Broken, "options", frozenset({"map"}))
    app = typer.Typer()
    app.command("live")(live)
    app.command("other")(lambda: None)
    monkeypatch.setattr(sys, "argv", ["edp", "live", "--log", "a.csv"])
    assert run_app(app) == 1
    said = capsys.readouterr().err
    assert "unexpected ValueError in test_live_contract.py" in " ".join(said.split())
    assert "Traceback" not in said


OPTIONS = sorted(set().union(*(kind.options for kind in SOURCES.values())))


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("source", sorted(SOURCES))
def test_an_option_of_another_source_is_refused_with_the_sources_it_belongs_to(source, option):
    if option in SOURCES[source].options:
        check_options(source, [option])
        return
    owners = [f"--{name}" for name in SOURCES if option in SOURCES[name].options]
    with pytest.raises(ConfigError, match=f"--{option} does not apply to --{source}") as error:
        check_options(source, [option])
    assert all(owner in str(error.value) for owner in owners)


OF_ALL = {"run", "monitor", "port", "bind", "save", "record", "rerun", "free-s", "json", *SOURCES}


def test_every_option_of_the_command_belongs_to_all_sources_or_to_some():
    hints = get_type_hints(live, include_extras=True)
    words = {"as-json": "json", "signal-map": "map"}
    names = {name.replace("_", "-") for name in inspect.signature(live).parameters}
    assert all(get_args(hints[name]) for name in inspect.signature(live).parameters)
    assert {words.get(name, name) for name in names} == OF_ALL | set(OPTIONS)


def test_steered_sources_have_a_speed_and_others_do_not():
    assert {name for name, kind in SOURCES.items() if "speed" in kind.options} == {
        name for name, kind in SOURCES.items() if kind.steered
    }


@pytest.mark.parametrize(
    "words",
    [["--log", "a.csv", "--rate", "100"], ["--log", "a.csv", "--seed", "0"],
     ["--log", "a.csv", "--rollout-seconds", "60"], ["--udp", "0", "--speed", "1"],
     ["--sim", "M22", "--udp-bind", "127.0.0.1"], ["--ros2", "--map", "a.toml"],
     ["--udp", "0", "--rate", "nan"], ["--sim", "M22", "--rate", "1e308"], ["--udp", "0", "--bind", ""],
     ["--udp", "0", "--rate", "100", "--udp-bind", ""], ["--sim", "M22", "--speed", "nan"], ["--log", "a", "--yes"]],
    ids=" ".join,
)  # fmt: skip
def test_options_without_effect_and_impossible_ones_are_refused(words, monkeypatch, capsys):
    app = typer.Typer()
    app.command("live")(live)
    app.command("other")(lambda: None)
    monkeypatch.setattr(sys, "argv", ["edp", "live", *words])
    assert run_app(app) != 0
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    "host", ["", " ", "\t", "a" * 300, "a\0b", "no.such.name.invalid", "1.2.3.4.5", "☃" * 70, "[::1"]
)
def test_an_address_that_is_none_is_refused_with_advice(host):
    with pytest.raises(ConfigError, match=r"--bind: got .*127\.0\.0\.1"):
        resolve_bind(host, "--bind")


@pytest.mark.parametrize(
    ("host", "local", "everywhere"),
    [("127.0.0.1", True, False), ("127.0.0.2", True, False), ("localhost", True, False), ("::1", True, False),
     ("0.0.0.0", False, True), ("::", False, True), ("0", False, True), ("192.0.2.1", False, False)],
)  # fmt: skip
def test_an_address_says_who_reaches_it(host, local, everywhere):
    address = resolve_bind(host, "--bind")
    assert (address.is_loopback, address.is_everywhere) == (local, everywhere)
    assert ("this computer" in address.reach) == local or everywhere


def test_rows_taken_from_a_network_are_told(monkeypatch):
    source = UdpSource(0, 100.0, CHANNELS, host="0.0.0.0")
    live_run = run_of(source)
    thread = threading.Thread(target=live_run.play)
    thread.start()
    ends = time.monotonic() + 20.0
    while not live_run.session.events() and time.monotonic() < ends:
        time.sleep(0.01)
    live_run.close()
    thread.join(20)
    assert "rows are taken from every computer of every network" in live_run.session.events()[0].text


def test_a_source_without_a_value_of_any_kind_is_not_taken(monkeypatch):
    monkeypatch.setattr("edp.workflows.live.sources.udp.STARTUP_S", 0.4)
    empty = Channel("x", Kind.GENERIC)
    source = UdpSource(0, 100.0, (empty,))
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for data in (b"{}", b'{"t":1}', b'{"t":2}'):
        sender.sendto(data, ("127.0.0.1", source.port))
    with pytest.raises(DataError, match="no row with a value"):
        source._first_channels()
    sender.close()
