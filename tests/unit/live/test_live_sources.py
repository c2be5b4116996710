"""Sources and what stands beside them: the numbers of batch runs; streams that stop, jump or change their rate."""

import json
import socket
import sys
import threading
import time
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from small_monitors import fitted_monitor

from edp.control.plants import TwinEnvironment
from edp.errors import ConfigError, DataError
from edp.logs.units import channel_from_entry
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.networks.stream import Stream
from edp.networks.twin import TWINS
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, ChannelMap, Kind, SignalMap
from edp.sim.excitation import EXCITATIONS
from edp.sim.scenario import Scenario
from edp.sim.simulate import Simulation
from edp.sim.view import view_of
from edp.testing.control import sample_excavator_twin
from edp.testing.monitor import rig_sessions
from edp.testing.twins import sample_actuators, sample_twin
from edp.training.bundle import make_bundle, save_bundle
from edp.training.twin_bundle import TwinBundle, save_twin
from edp.workflows.live import SOURCES, LiveOrder, LiveRun, SourceOptions
from edp.workflows.live.free_run import LiveTwin
from edp.workflows.live.look_ahead import LiveNetwork, spread
from edp.workflows.live.run_live import AT_ONCE
from edp.workflows.live.sources.arrivals import RowClock, Step
from edp.workflows.live.sources.base import LiveSource, Needs
from edp.workflows.live.sources.log import LogSource
from edp.workflows.live.sources.sim import SimSource, view_of_truth
from edp.workflows.live.sources.udp import MOST_BYTES, UdpSource, row_of
from edp.workflows.live.watch import LiveMonitor

FAST = float("inf")


def run_of(source: LiveSource, **order) -> LiveRun:
    return LiveRun(LiveOrder("test", SourceOptions(""), speed=FAST, **order), source=source)


def played(live: LiveRun) -> np.ndarray:
    live.play()
    if live.failure is not None:
        raise live.failure
    return live.session.read(0, live.session.ticks)[1]


@pytest.fixture
def network(tiny, tiny_model, tmp_path):
    torch.manual_seed(0)
    predictor = Predictor(tiny.task, tiny_model, tiny.scaler()).eval()
    return predictor, save_bundle(make_bundle(predictor, tiny), tmp_path / "run" / "bundle").parent


def recording_of(tiny) -> Recording:
    return Recording("log", tiny.inputs, tiny.test[0].inputs, 100.0)


def test_a_played_log_gives_the_numbers_of_an_evaluation(tiny, network):
    predictor, run = network
    live = run_of(LogSource(recording_of(tiny)), run=run)
    rows = played(live)
    expected = stream_predictions(predictor, tiny.test)[0]
    layout = live.session.layout
    assert live.session.ticks == len(expected) == layout.ticks
    assert live.session.ended.startswith("the log has ended")
    for n, (horizon, target) in enumerate((h, t) for h in range(2) for t in range(3)):
        forecast = layout.forecasts[n]
        assert (forecast.ticks, forecast.measured) == (tiny.task.horizons[horizon], target)
        np.testing.assert_allclose(rows[:, forecast.column], expected[:, horizon, target], rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(rows[:, :4], tiny.test[0].inputs)


def test_a_source_without_the_channels_of_a_network_is_refused(tiny, network):
    recording = recording_of(tiny)
    fewer = Recording("log", recording.channels[1:], recording.values[:, 1:], 100.0)
    with pytest.raises(ConfigError, match="the network reads boom, which the source does not give"):
        run_of(LogSource(fewer), run=network[1])
    slow = Recording("log", recording.channels, recording.values, 50.0)
    with pytest.raises(ConfigError, match=r"has 50 Hz, the run 100 Hz"):
        run_of(LogSource(slow), run=network[1])


def test_missing_values_are_held_and_told_once_and_gaps_restart(tiny, network):
    _, run = network
    live = run_of(LogSource(recording_of(tiny)), run=run)
    good = tiny.test[0].inputs
    bad = good[0].copy()
    bad[1] = np.nan
    for row in (*good[:20], bad, bad, *good[20:30]):
        live.take(row)
    live.show()
    texts = [event.text for event in live.session.events()]
    # Rows are taken many at once here; each event stands at its own tick all the same.
    assert [event.tick for event in live.session.events() if event.group in ("held", "reads")] == [20, 22]
    assert sum("holds the last ones" in text for text in texts) == 1
    assert sum("all values again" in text for text in texts) == 1
    live.take(good[30], missed=10_000)
    live.take(good[31], trusted=False)
    live.show()
    column = live.session.layout.forecasts[0].column
    assert np.isnan(live.session.read(live.session.ticks - 1, 1)[1][0, column])


def test_rows_that_are_due_together_give_the_numbers_of_rows_one_by_one(tiny, network, monkeypatch):
    recording, asked = recording_of(tiny), []
    steps = Stream.steps
    monkeypatch.setattr(Stream, "steps", lambda self, rows: asked.append(len(rows)) or steps(self, rows))
    together = played(run_of(LogSource(recording), run=network[1]))
    assert max(asked) == AT_ONCE
    monkeypatch.setattr(sys.modules[LiveRun.__module__], "AT_ONCE", 1)
    alone = played(run_of(LogSource(recording), run=network[1]))
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)


def test_a_source_that_keeps_up_is_shown_row_by_row(tiny):
    live = LiveRun(LiveOrder("test", SourceOptions(""), speed=1.0), source=LogSource(recording_of(tiny)))
    clock = [0.0]
    live.pace._clock = lambda: clock[0]
    for tick, row in enumerate(tiny.test[0].inputs[:5]):
        live.take(row)
        assert live.session.ticks == tick + 1
        clock[0] += 0.01
    clock[0] += 0.05  # the models were slow: six rows are due
    for tick, row in enumerate(tiny.test[0].inputs[5:11]):
        live.take(row)
        assert live.session.ticks == (5 if tick < 5 else 11)
    live.close()


def test_of_many_horizons_the_first_and_the_last_are_shown():
    assert spread(3) == [0, 1, 2]
    assert spread(40) == [0, 8, 16, 23, 31, 39]


def twin_bundle() -> TwinBundle:
    spec = next(iter(TWINS.values()))()
    return TwinBundle(spec, sample_twin(spec, sample_actuators(600))[0])


def test_a_twin_runs_free_beside_the_log_and_begins_anew():
    bundle, recording, notes = twin_bundle(), sample_actuators(600).rows(0, 300), []
    twin = bundle.twin
    part = LiveTwin(bundle, recording.channels, lambda kind, text, group: notes.append(text), free_s=2.0)
    rows = np.array([part.step(row, 0) for row in recording.values])
    series = twin.channels.task().series(recording)
    prefix, free = twin.prefix_ticks, 100
    assert np.isnan(rows[:prefix]).all()
    state = twin.reset(series.inputs[None, :prefix], series.targets[None, :prefix])
    expected, _ = twin.rollout(series.inputs[None, prefix : prefix + free], state)
    count = len(twin.channels.answers)
    np.testing.assert_allclose(rows[prefix : prefix + free, :count], expected[0], rtol=1e-4, atol=1e-5)
    assert len(notes) == 1 + (300 - prefix - 1) // free
    missing = recording.values[0].copy()
    missing[0] = np.nan
    assert np.isnan(part.step(missing, 0)).all()
    far = recording.values[0].copy()
    far[recording.index("stroke_1")] += 5.0
    for _ in range(3 * prefix):
        assert np.isnan(part.step(far, 0)).all()
    assert "cannot begin here" in notes[-1]
    assert {forecast.ticks for forecast in part.forecasts(7)} == {1}


@pytest.mark.long
def test_alarms_are_those_of_the_monitor_and_nothing_else_is_one():
    monitor = fitted_monitor()
    healthy = rig_sessions(1, 1500, seed=9)[0]
    values = healthy.values.copy()
    values[700:, 0] += 5 * np.std(values[:, 0])
    faulty = Recording("rig", healthy.channels, values, healthy.rate_hz)
    expected = monitor.watch(faulty)
    notes = []
    part = LiveMonitor(monitor, faulty.channels, faulty.rate_hz, lambda *event: notes.append(event))
    rows = np.array([part.step(row, 0) for row in faulty.values])
    alarms = [text for kind, text, _ in notes if kind == "alarm"]
    assert len(alarms) == len(expected.alarms) > 0
    assert all(group for kind, _, group in notes if kind == "alarm")
    np.testing.assert_allclose(rows[-1], expected.statistics[-1] / monitor.chain.limit, rtol=1e-3, atol=1e-3)
    with pytest.raises(ConfigError, match="set rate_hz"):
        LiveMonitor(monitor, faulty.channels, 50.0, lambda *event: None)
    with pytest.raises(ConfigError, match="none of the monitor's channels"):
        LiveMonitor(monitor, (Channel("x", Kind.VELOCITY),), faulty.rate_hz, lambda *event: None)


@pytest.mark.long
def test_the_simulator_works_on_and_its_operator_sees_what_the_batch_simulation_shows():
    live = run_of(SimSource("M22", 100.0, 3))
    thread = threading.Thread(target=live.play)
    thread.start()
    while live.session.ticks < 600:
        time.sleep(0.02)
    live.pace.stop()
    thread.join(20)
    rows, layout = live.session.read(0, 600)[1], live.session.layout
    assert live.session.ended == "the session was ended"
    assert np.isfinite(rows).all()
    assert [layout.traces[n].name for n in layout.levers] == ["Lever_1", "Lever_2", "Lever_3"]
    assert np.ptp(rows[:, list(layout.levers)]) > 0.1
    assert np.ptp(rows[:, list(layout.angles)], axis=0).min() > 1e-3
    simulation = Simulation(Scenario(machine="M22", duration_s=2.0))
    simulation.run(50)
    view = view_of(simulation.plant)
    full = np.array(simulation.machine.cylinders.stroke)
    source = SimSource("M22", 100.0)
    _, info = source._env.reset(seed=0)
    seen = view_of_truth(info["truth"], full)
    assert all(np.shape(a) == np.shape(b) for a, b in zip(view[:7], seen[:7], strict=True))
    assert source._env.tip(full * seen.strokes)[:3] == pytest.approx([seen.tip_x, seen.tip_y, seen.attitude], abs=1e-6)
    wanted = Needs((Channel("PumpPressure_1", Kind.PRESSURE), Channel("other", Kind.PRESSURE)), 50.0)
    needed = SOURCES["sim"].from_options(SourceOptions("M22"), wanted)
    assert needed.rate_hz == 50.0
    assert "PumpPressure_1" in [channel.name for channel in needed.channels]
    with pytest.raises(ConfigError, match="unknown excitation"):
        SimSource("M22", 100.0, settings={"excitation": "nobody"})
    ground = next(name for name, kind in EXCITATIONS.items() if kind.works_ground)
    with pytest.raises(ConfigError, match="works the ground"):
        SimSource("M22", 100.0, settings={"excitation": ground})


@pytest.mark.long
@pytest.mark.parametrize("twin_as_plant", [False, True])
def test_a_loop_is_shown_with_reference_and_levers(twin_as_plant, tmp_path):
    settings: dict[str, object] = {"controller": "pi"}
    if twin_as_plant:
        bundle = TwinBundle(TWINS["static"](), sample_excavator_twin())
        settings["plant"] = save_twin(bundle, tmp_path / "twin")
    source = SOURCES["loop"].from_options(SourceOptions("point", settings=settings), Needs())
    assert isinstance(source._env, TwinEnvironment) == twin_as_plant
    live = run_of(source)
    thread = threading.Thread(target=live.play)
    thread.start()
    while live.session.ticks < 200 and live.failure is None:
        time.sleep(0.02)
    live.pace.stop()
    thread.join(30)
    assert live.failure is None
    names = [channel.name for channel in source.channels]
    rows = live.session.read(0, 200)[1]
    assert {"Reference_TipX", "Lever_1", "CylStroke_1"} <= set(names)
    assert np.isfinite(rows).all()


@pytest.mark.parametrize(
    "data",
    [b"", b"\xff", b"[1,2]", b"1", b'{"a":"x"}', b'{"a":true}', b'{"a":[1]}', b'{"a":{"b":1}}', b'{"a":1,"a":2}',
     b'{"a":NaN}', b'{"t":null}', b"{" * 50, b'{"a":1' + b" " * MOST_BYTES + b"}", b'{"a":1e999}',
     json.dumps({str(n): 1 for n in range(300)}).encode()],
)  # fmt: skip
def test_a_datagram_that_is_no_row_is_refused(data):
    with pytest.raises(DataError):
        row_of(data)


def test_a_datagram_is_a_row_with_missing_values():
    row = row_of(b'{"t":1.5,"a":2,"b":null}')
    assert (row["t"], row["a"], np.isnan(row["b"])) == (1.5, 2.0, True)


def test_the_clock_of_rows_sees_gaps_other_rates_and_time_that_goes_back():
    clock = RowClock(100.0)
    assert [clock.tick(k / 100) for k in range(60)] == [Step()] * 60
    assert clock.measured_hz == pytest.approx(100.0)
    assert clock.tick(0.59 + 0.05) == Step(4)
    assert clock.tick(0.0) == Step(restart="time went back")
    for k in range(1, 200):
        clock.tick(k / 50)
    assert not clock.trusted
    assert clock.measured_hz == pytest.approx(50.0)
    for k in range(200):
        clock.tick(4 + k / 100)
    assert clock.trusted


class Sender:
    """Datagrams to a source."""

    def __init__(self, source: UdpSource) -> None:
        self._socket, self._address = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), ("127.0.0.1", source.port)

    def send(self, data: bytes) -> None:
        self._socket.sendto(data, self._address)

    def rows(self, first: int, count: int, rate: float = 100.0, **values: float) -> None:
        for k in range(first, first + count):
            self.send(json.dumps({"t": k / rate, **values}).encode())
            time.sleep(0.0005)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def datagrams():
    channels = (Channel("speed", Kind.VELOCITY), Channel("<script>", Kind.GENERIC))
    source = UdpSource(0, 100.0, channels)
    live, sender = run_of(source), Sender(source)
    thread = threading.Thread(target=live.play)
    thread.start()
    yield live, sender
    live.close()
    thread.join(20)
    sender.close()
    assert not thread.is_alive()


def until(condition, seconds: float = 20.0) -> None:
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.01)


def texts(live: LiveRun) -> str:
    return "\n".join(event.text for event in live.session.events())


def test_rows_come_by_datagrams_and_odd_ones_are_told(datagrams):
    live, sender = datagrams
    sender.send(b"not a row")
    sender.rows(0, 100, speed=0.5, **{"<script>": 2.0, "other": 1.0})
    until(lambda: live.session.ticks == 100)
    assert live.session.read(0, 1)[1].tolist() == [[0.5, 2.0]]
    assert "row 1 that cannot be used" in texts(live)
    for _ in range(100):
        sender.send(b"{}")
    until(lambda: live.session.ticks == 200)  # an empty row misses all values
    assert np.isnan(live.session.read(199, 1)[1]).all()


def test_a_stream_that_stops_goes_back_or_changes_its_rate_is_told(datagrams):
    live, sender = datagrams
    sender.rows(0, 60, speed=1.0)
    until(lambda: "no row for 0.5 s" in texts(live))
    sender.rows(200, 10, speed=1.0)
    until(lambda: "rows come again" in texts(live))
    sender.rows(0, 5, speed=1.0)
    until(lambda: "time went back" in texts(live))
    sender.rows(10, 150, rate=50.0, speed=1.0)
    until(lambda: "the models know 100 Hz" in texts(live))
    sender.rows(1000, 200, speed=1.0)
    until(lambda: "Hz again" in texts(live))
    assert live.alarms == 0


def test_a_map_gives_names_and_units_to_columns():
    signal_map = SignalMap(channels=(ChannelMap("CylVels_1", "v", unit="mm/s"), ChannelMap("idle", "", constant=3.0)))
    source = UdpSource(0, 100.0, tuple(channel_from_entry(entry) for entry in signal_map.channels), signal_map)
    assert source._row({"v": 250.0}).tolist() == [0.25, 3.0]
    with pytest.raises(ConfigError, match=r"--udp \d+: cannot listen"):
        UdpSource(source.port, 100.0, source.channels)
    source.close()
    with pytest.raises(ConfigError, match="give --rate"):
        SOURCES["udp"].from_options(SourceOptions("0"), Needs())


def test_channels_of_a_first_row_are_taken_where_nothing_else_names_them(monkeypatch):
    monkeypatch.setattr("edp.workflows.live.sources.udp.STARTUP_S", 0.2)
    with pytest.raises(DataError, match="start the sender first"):
        UdpSource(0, 100.0)


def test_without_ros_the_source_says_what_is_missing():
    with pytest.raises(ConfigError, match="--ros2 needs ROS 2 with rclpy"):
        SOURCES["ros2"].from_options(SourceOptions("ros2", rate_hz=100.0), Needs())


def test_joints_and_pressures_of_ros_are_rows(monkeypatch):
    """Against a stand-in that has what the source calls of rclpy; there is no ROS here."""
    subscriptions, spun = {}, []
    node = SimpleNamespace(
        create_subscription=lambda kind, topic, take, qos: subscriptions.update({topic: take}),
        destroy_node=lambda: None,
    )
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="CylPressures_1")

    def spin_once(node, timeout_sec):
        spun.append(0)
        if len(spun) > 20:
            raise ConfigError("enough")
        header.stamp.nanosec = 10_000_000 * len(spun)
        subscriptions["pressures"](SimpleNamespace(header=header, fluid_pressure=7e6))
        joints = SimpleNamespace(header=header, name=["CylVels_1", "x"], velocity=[0.25, 1.0], position=[], effort=[])
        subscriptions["joint_states"](joints)

    modules = {name: ModuleType(name) for name in ("rclpy", "rclpy.qos", "sensor_msgs", "sensor_msgs.msg")}
    modules["rclpy"].init, modules["rclpy"].try_shutdown = lambda args: None, lambda: None
    modules["rclpy"].create_node, modules["rclpy"].spin_once = lambda name: node, spin_once
    modules["rclpy.qos"].qos_profile_sensor_data = 5
    modules["sensor_msgs.msg"].JointState = modules["sensor_msgs.msg"].FluidPressure = object
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    channels = (TABLE_A1["CylVels_1"], TABLE_A1["CylPressures_1"], TABLE_A1["CylVels_2"])
    live = run_of(SOURCES["ros2"].from_options(SourceOptions("ros2"), Needs(channels, 100.0)))
    live.play()
    assert "enough" in str(live.failure)
    assert live.session.ticks == 20
    row = live.session.read(19, 1)[1][0]
    assert row[:2].tolist() == [0.25, 7e6]
    assert np.isnan(row[2])


def test_every_source_is_an_option_of_the_command():
    from edp.cli.live import LIVE_SOURCES

    assert set(LIVE_SOURCES) == set(SOURCES)


def test_only_part_of_a_network_can_be_shown(network, tiny):
    live = run_of(LogSource(recording_of(tiny)), run=network[1])
    assert any(isinstance(part, LiveNetwork) for part in live._parts)
    assert live.session.layout.geometry is None
