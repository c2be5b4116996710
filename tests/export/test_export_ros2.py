"""The ROS 2 package: its C code against PyTorch, its rules, the node against a stand-in of rclpy, a bag without ROS.

There is no ROS here: the stand-in has what the node calls of rclpy and the fields of messages that it uses, no more.
"""

from __future__ import annotations

import importlib
import io
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from edp.export import make_target
from edp.export.golden import random_inputs, stream, tolerance

yaml = pytest.importorskip("yaml")
NAMES = ("CylVels_1", "CylVels_3", "pressure", "lever", "load")
SOURCES = [
    "CylVels_1=velocity:boom",
    "CylVels_3=velocity:bucket",
    "pressure=pressure:head",
    "lever=position:stick",
    "load=constant:0.5",
]


@pytest.fixture(scope="session")
def package_of(c, bundle_of, tmp_path_factory):
    """The exported and compiled package: the folder of its modules."""
    made = {}

    def make(structure, whole=False):
        c.need("gcc")
        if (structure, whole) not in made:
            folder = tmp_path_factory.mktemp("ros2")
            make_target("ros2").write(bundle_of(structure, whole), "predictor", folder)
            core.build("gcc", folder / "predictor_ros")
            made[structure, whole] = folder / "predictor_ros"
        return made[structure, whole]

    return make


core = importlib.import_module("edp.export.ros2.package.core")


@pytest.fixture
def ticks(package_of):
    made = core.Core(package_of("hybrid+all"))
    return core.Assembler(made, core.read_sources(made.inputs, SOURCES))


def rows_of(bundle_of, count=40):
    rows = random_inputs(bundle_of("hybrid+all").predictor, count, seed=4)
    rows[:, 4] = 0.5
    return rows


def fed(ticks, row, stamp, **changed):
    """A tick by messages; a pressure first."""
    ticks.pressure("head", float(row[2]), changed.get("measured", stamp))
    names = changed.get("names", ["stick", "bucket", "boom"])
    values = {"stick": row[3], "bucket": row[1], "boom": row[0]}
    given = [float(values[name]) for name in names]
    return ticks.joints(names, given, given, [], stamp)


@pytest.mark.parametrize("whole", [False, True])
def test_the_core_predicts_what_pytorch_predicts(whole, package_of, bundle_of):
    predictor = bundle_of("hybrid+quantiles" if not whole else "hybrid", whole).predictor
    made = core.Core(package_of("hybrid+quantiles" if not whole else "hybrid", whole))
    other = core.Core(package_of("hybrid+quantiles" if not whole else "hybrid", whole))
    inputs = random_inputs(predictor, 60, seed=3)
    found = []
    for row in inputs:
        assert made.step(row.tolist()) <= core.CallStatus.WARMING
        other.step((2 * row).tolist())  # another machine beside it
        found.append(np.concatenate([np.ravel(made.result(meaning)) for meaning in made.results]))
    wanted = stream(predictor, inputs)
    assert (np.abs(found - wanted) <= tolerance(predictor, inputs, wanted)).all()
    assert made.counts == {"ticks": 60, "rejected": 0, "held": 0, "restarts": 0}
    made.reset()
    made.step(inputs[0].tolist())
    again = np.ravel(made.result())
    np.testing.assert_array_equal(again, found[0][: len(again)])
    with pytest.raises(ValueError, match=r"4 numbers; the network reads 5"):
        made.step(inputs[0, 1:].tolist())


def test_messages_become_the_ticks_of_the_stream(ticks, bundle_of):
    """By name, whatever the order of joints; with jitter below half a tick."""
    rows, found = rows_of(bundle_of), []
    jitter = np.random.default_rng(0).uniform(-0.002, 0.002, len(rows))
    for at, row in enumerate(rows):
        tick = fed(ticks, row, 100.0 + 0.01 * at + jitter[at])
        assert tick.predicted
        assert tick.valid == (at >= core.RATE_MESSAGES)  # later than a window here
        found.append(np.ravel(ticks.core.result()))
    wanted = stream(bundle_of("hybrid+all").predictor, rows)
    assert (np.abs(found - wanted) <= tolerance(bundle_of("hybrid+all").predictor, rows, wanted)).all()
    assert tick.step_us > 0
    assert not tick.why


def test_missed_ticks_are_held_and_long_gaps_forget(ticks, bundle_of):
    rows = rows_of(bundle_of)
    for at in range(20):
        fed(ticks, rows[at], 0.01 * at)
    tick = fed(ticks, rows[20], 0.22)
    assert (tick.missed, tick.valid, ticks.core.counts["held"]) == (2, True, 2)
    same = np.array(ticks.core.result())
    held = np.concatenate([rows[:20], rows[[19, 19, 20]]])
    np.testing.assert_allclose(same.ravel(), stream(bundle_of("hybrid+all").predictor, held)[-1], rtol=1e-3, atol=1e-4)
    tick = fed(ticks, rows[21], 0.22 + 0.07)
    assert (tick.missed, tick.status, ticks.core.counts["restarts"]) == (6, core.CallStatus.WARMING, 1)


def test_late_and_double_messages_are_no_ticks(ticks, bundle_of):
    rows = rows_of(bundle_of)
    for at in range(12):
        fed(ticks, rows[at], 0.01 * at)
    for stamp in (0.11, 0.105, 0.05, 0.1149):
        tick = fed(ticks, rows[12], stamp)
        assert tick.status is None
        assert "is no tick" in tick.why
    assert fed(ticks, rows[12], 0.12).valid
    assert (ticks.rejected, ticks.core.counts["ticks"]) == (4, 13)
    tick = fed(ticks, rows[0], -50.0)  # another recording
    assert (tick.status, ticks.core.counts["ticks"]) == (core.CallStatus.WARMING, 1)


@pytest.mark.parametrize(("rate", "said"), [(50.0, "at 50.0 Hz"), (125.0, "at 125.0 Hz"), (1000.0, "at 1000.0 Hz")])
def test_another_rate_is_refused(rate, said, ticks, bundle_of):
    rows = rows_of(bundle_of)
    seen = [fed(ticks, rows[at], at / rate) for at in range(40)]
    assert not any(tick.valid for tick in seen)
    assert all(said in tick.why and "100 Hz" in tick.why for tick in seen[12:])
    assert not any(tick.predicted for tick in seen[12:])
    later = [fed(ticks, rows[at % 40], 40 / rate + 0.01 * at) for at in range(40)]
    assert later[-1].valid  # the right rate starts it anew


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"names": ["stick", "boom"]}, "CylVels_3 (velocity of bucket)"),
        ({"measured": 0.05}, "pressure (pressure of head)"),
        ({"row": [np.nan, 0, 0, 0, 0]}, "CylVels_1 (velocity of boom)"),
        ({"row": [0, 0, np.inf, 0, 0]}, "pressure (pressure of head)"),
        ({"row": [3e38, 0, 0, 0, 0]}, "beyond its limits"),
    ],
)
def test_missing_old_and_bad_inputs_are_held_and_named(changed, said, ticks, bundle_of):
    rows = rows_of(bundle_of)
    for at in range(12):
        row = rows[at]
        ticks.pressure("head", float(row[2]), 0.01 * at)
        ticks.joints(["boom", "bucket", "stick"], [0, 0, row[3]], [row[0], row[1], 0], [], 0.01 * at)
    if "measured" in changed:
        row = rows[12]
        tick = ticks.joints(["boom", "bucket", "stick"], [0, 0, row[3]], [row[0], row[1], 0], [], 0.14)
    else:
        tick = fed(
            ticks, np.array(changed.get("row", rows[12])), 0.12, names=changed.get("names", ["stick", "bucket", "boom"])
        )
    assert tick.status is core.CallStatus.HELD
    assert not tick.valid
    assert said in tick.why
    for at in range(13, 30):
        tick = fed(ticks, rows[at], 0.15 + 0.01 * (at - 13))
    assert tick.valid


def test_sources_that_do_not_fit_are_all_named():
    with pytest.raises(
        ValueError, match=r"'boom' .*'lever=force:x'.*inputs without a source: CylVels_1.*no input: other"
    ):
        core.read_sources(list(NAMES), ["boom", "lever=force:x", "other=constant:1", *SOURCES[1:3]])
    with pytest.raises(ValueError, match="is no number"):
        core.read_sources(list(NAMES), [*SOURCES[:-1], "load=constant:x"])
    with pytest.raises(ValueError, match="not read: 'lever"):
        core.read_sources(list(NAMES), [*SOURCES, SOURCES[3]])


def test_a_package_that_was_not_built_says_so(bundle_of, tmp_path):
    make_target("ros2").write(bundle_of("hybrid+all"), "predictor", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"build the package"):
        core.Core(tmp_path / "predictor_ros")
    with pytest.raises(RuntimeError, match="does not start"):
        core.build("no-such-compiler", tmp_path / "predictor_ros")
    (tmp_path / "predictor_ros/csrc/predictor.c").write_text("this is no C")
    with pytest.raises(RuntimeError, match="cannot compile"):
        core.build("cc", tmp_path / "predictor_ros")


def test_it_builds_as_colcon_builds_it(c, bundle_of, tmp_path):
    c.need("gcc")
    make_target("ros2").write(bundle_of("lstm"), "predictor", tmp_path)
    manifest = ElementTree.parse(tmp_path / "package.xml").getroot()
    assert (manifest.find("name").text, manifest.find("export/build_type").text) == ("predictor_ros", "ament_python")
    params = yaml.safe_load((tmp_path / "config/params.yaml").read_text())["predictor"]["ros__parameters"]
    assert params["rate_hz"] == 100.0
    assert set(core.read_sources(list(NAMES), params["sources"])) == set(NAMES)
    compile((tmp_path / "launch/predictor.launch.py").read_text(), "launch", "exec")
    c.run(sys.executable, "setup.py", "-q", "build", folder=tmp_path)
    built = tmp_path / "build/lib/predictor_ros"
    assert (built / "libcore.so").exists()
    program = (
        "from predictor_ros.core import Core; import sys; c = Core(); print(c.step([0.0] * len(c.inputs)).name);"
        "assert not {'torch', 'edp', 'numpy'} & set(sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", program], cwd=built.parent, env={}, check=True, capture_output=True)
    assert found.stdout.strip() == b"WARMING"


class Message(SimpleNamespace):
    """Any message: fields by name, a header with a time."""

    def __init__(self, **fields):
        stamp = SimpleNamespace(sec=0, nanosec=0)
        super().__init__(header=SimpleNamespace(stamp=stamp, frame_id=""), position=[], velocity=[], effort=[])
        self.__dict__.update(fields)


def stand_in(parameters):
    """Modules that look like rclpy to the node, and everything that it published."""
    sent, logged = [], []

    class Node:
        def __init__(self, name):
            self.name, self.parameters, self.heard, self.timers = name, {}, {}, []

        def declare_parameter(self, name, value):
            self.parameters[name] = parameters.get(name, value)

        def get_parameter(self, name):
            return SimpleNamespace(value=self.parameters[name])

        def create_publisher(self, kind, topic, qos_profile):
            return SimpleNamespace(publish=lambda message: sent.append((topic, message)))

        def create_subscription(self, kind, topic, callback, qos):
            self.heard[topic] = callback

        def create_timer(self, seconds, callback):
            self.timers.append(callback)

        def get_logger(self):
            return SimpleNamespace(warning=logged.append)

        def get_clock(self):
            return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))

        def get_name(self):
            return self.name

    names = {"sensor_msgs": ("FluidPressure", "JointState"), "std_msgs": ("Bool", "Float64")}
    names["diagnostic_msgs"] = ("DiagnosticArray", "DiagnosticStatus", "KeyValue")
    made = {name: ModuleType(name) for name in ("rclpy", "rclpy.node", "rclpy.qos")}
    made["rclpy.node"].Node, made["rclpy.qos"].qos_profile_sensor_data = Node, 5
    for room, kinds in names.items():
        made[room], made[f"{room}.msg"] = ModuleType(room), ModuleType(f"{room}.msg")
        for kind in kinds:
            setattr(made[f"{room}.msg"], kind, type(kind, (Message,), {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3}))
    return made, sent, logged


@pytest.fixture
def node_of(package_of, monkeypatch):
    def make(**parameters):
        modules, sent, logged = stand_in({"sources": SOURCES, **parameters})
        for name, module in modules.items():
            monkeypatch.setitem(sys.modules, name, module)
        for name in ("node", "tick_node"):
            monkeypatch.delitem(sys.modules, f"edp.export.ros2.package.{name}", raising=False)
        node = importlib.import_module("edp.export.ros2.package.node")
        folder = package_of("hybrid+all")
        monkeypatch.setattr(node, "Core", lambda: core.Core(folder))
        return node.PredictorNode(), sent, logged

    return make


def stamped(at):
    return SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=round(1e7 * at)), frame_id="head")


def test_the_node_publishes_predictions_validity_and_timing(node_of, bundle_of):
    node, sent, logged = node_of()
    rows = rows_of(bundle_of, 30)
    for at, row in enumerate(rows):
        node.heard["pressures"](Message(header=stamped(at), fluid_pressure=float(row[2])))
        if at == 20:
            row = row * np.nan
        fields = {"name": ["boom", "bucket", "stick"], "position": [0, 0, row[3]], "velocity": [row[0], row[1], 0]}
        node.heard["joint_states"](Message(header=stamped(at), **fields))
    node.timers[0]()
    topics = [topic for topic, _ in sent]
    valid = [message.data for topic, message in sent if topic == "~/valid"]
    assert valid == [at >= core.RATE_MESSAGES and at != 20 for at in range(30)]
    ahead = [entry["ticks"] for entry in node.ticks.core.about["horizons"]]
    assert topics.count(f"~/prediction/ahead_{ahead[0]}") == 30
    last = dict(sent)
    for number, k in enumerate(ahead):
        message = last[f"~/prediction/ahead_{k}"]
        assert message.name == ["CylVels_1", "CylVels_3"]
        numbers = next(part for part in (message.velocity, message.position, message.effort) if part)
        np.testing.assert_array_equal(numbers, node.ticks.core.result()[0][number])
        assert message.header.stamp.nanosec == round(1e7 * 29)
    assert last["~/step_us"].data > 0
    status = last["/diagnostics"].status[0]
    assert (status.level, status.message) == (0, "predicting")
    assert {value.key for value in status.values} >= {"rejected", "held", "messages_rejected", "step_us", "model_hash"}
    assert any("not finite: CylVels_1" in text for text in logged)
    node.timers[0]()
    assert sent[-2][1].data is False
    assert sent[-1][1].status[0].message == "no joints in the last second"


def test_the_node_does_not_start_with_wrong_parameters(node_of):
    with pytest.raises(ValueError, match=r"rate_hz is 50\.0; the network was trained at 100"):
        node_of(rate_hz=50.0)
    with pytest.raises(ValueError, match="inputs without a source: load"):
        node_of(sources=SOURCES[:-1])
    with pytest.raises(ValueError, match="inputs without a source"):
        node_of(sources=[""])


def test_a_bag_is_replayed_without_ros(package_of, bundle_of, tmp_path):
    rosbags = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    replay = importlib.import_module("edp.export.ros2.package.replay")
    types = get_typestore(Stores.ROS2_HUMBLE).types
    store, rows = get_typestore(Stores.ROS2_HUMBLE), rows_of(bundle_of, 30)
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    joint, pressure = types["sensor_msgs/msg/JointState"], types["sensor_msgs/msg/FluidPressure"]
    with rosbags.Writer(tmp_path / "bag", version=9, storage_plugin=rosbags.StoragePlugin.MCAP) as writer:
        kinds = [("/joint_states", joint), ("/pressures", pressure)]
        topics = [writer.add_connection(topic, kind.__msgtype__, typestore=store) for topic, kind in kinds]
        for at, row in enumerate(rows):
            stamp = time(sec=7, nanosec=10_000_000 * at)
            near = pressure(header(stamp, "head"), fluid_pressure=float(row[2]), variance=0.0)
            fields = [np.array(part, float) for part in ([0, 0, row[3]], [row[0], row[1], 0], [])]
            both = (joint(header(stamp, ""), ["boom", "bucket", "stick"], *fields), near)
            for topic, message in ((topics[1], both[1]), (topics[0], both[0])):
                raw = store.serialize_cdr(message, topic.msgtype)
                writer.write(topic, 7_000_000_000 + 10_000_000 * at, raw)
    (tmp_path / "params.yaml").write_text(yaml.safe_dump({"predictor": {"ros__parameters": {"sources": SOURCES}}}))
    made = core.Core(package_of("hybrid+all"))
    ticks = core.Assembler(made, core.read_sources(made.inputs, replay.sources_of(tmp_path / "params.yaml")))
    to = io.StringIO()
    assert replay.write(tmp_path / "bag", ticks, to) == 30 - core.RATE_MESSAGES
    lines = [line.split(",") for line in to.getvalue().splitlines()]
    found = np.array([[float(value) for value in line[4:]] for line in lines[1:]])
    predictor = bundle_of("hybrid+all").predictor
    wanted = stream(predictor, rows)
    assert (np.abs(found - wanted) <= tolerance(predictor, rows, wanted)).all()
    assert lines[0][4].startswith("CylVels_1+")
    (tmp_path / "empty.yaml").write_text("")
    with pytest.raises(ValueError, match="no ros__parameters"):
        replay.sources_of(tmp_path / "empty.yaml")


@pytest.fixture(scope="session")
def watch_package(c, rig_monitor, tmp_path_factory):
    """The exported and compiled package of a monitor: the folder of its modules."""
    from edp.export.monitor import write_monitor_ros2
    from edp.workflows.monitor.export_monitor import monitor_parts

    c.need("gcc")
    folder = tmp_path_factory.mktemp("watch")
    write_monitor_ros2(monitor_parts(rig_monitor, golden=False), "watch", folder)
    core.build("gcc", folder / "watch_ros")
    return folder / "watch_ros"


@pytest.fixture
def watching(watch_package, monkeypatch):
    """The node of a monitor against the stand-in, and what it published."""
    sources = [f"{name}=position:{name}" for name in ("command", "velocity", "stroke")]
    sources += [f"{name}=pressure:{name}" for name in ("pressure_a", "pressure_b")]
    modules, sent, logged = stand_in({"sources": sources})
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    for name in ("watch_node", "tick_node"):
        monkeypatch.delitem(sys.modules, f"edp.export.ros2.package.{name}", raising=False)
    node = importlib.import_module("edp.export.ros2.package.watch_node")
    watch = importlib.import_module("edp.export.ros2.package.watch")
    monkeypatch.setattr(node, "MonitorCore", lambda: watch.MonitorCore(watch_package))
    return node.MonitorNode(), sent, logged


def tell(node, rows, first=0):
    names = node.ticks.core.inputs
    for at, row in enumerate(rows, first):
        values = dict(zip(names, row.tolist()))
        for name in ("pressure_a", "pressure_b"):
            header = SimpleNamespace(stamp=SimpleNamespace(sec=at // 100, nanosec=at % 100 * 10**7), frame_id=name)
            node.heard["pressures"](Message(header=header, fluid_pressure=values[name]))
        header = SimpleNamespace(stamp=SimpleNamespace(sec=at // 100, nanosec=at % 100 * 10**7), frame_id="")
        joints = ["command", "velocity", "stroke"]
        node.heard["joint_states"](Message(header=header, name=joints, position=[values[name] for name in joints]))


def test_the_node_of_a_monitor_tells_its_alarms_as_diagnostics(watching, rig_fault):
    node, sent, logged = watching
    tell(node, rig_fault[:900])
    assert sent == []
    node.timers[0]()
    status = sent[-1][1].status[0]
    assert (status.level, status.message, status.name) == (0, "healthy", "monitor")
    assert sent[-2][1].data is False
    assert {value.key for value in status.values} >= {"alarms", "statistic_0", "silent", "rejected", "monitor_hash"}
    # Nothing came since: the verdict is no longer one of now.
    node.timers[0]()
    assert sent[-1][1].status[0].level == 3
    sent.clear()
    tell(node, rig_fault[900:], 900)
    # At once, without the timer.
    status = next(message.status[0] for topic, message in sent if topic == "/diagnostics")
    assert logged == ["alarm"] * len(logged)
    assert status.level == 2
    assert "deviates most" in status.message
    evidence = {value.key: float(value.value) for value in status.values if value.key.startswith("evidence.")}
    assert any("pressure_a" in name for name in evidence)
    assert sent[0][1].data is True
    assert sent[0][0] == "~/alarm"


def test_the_node_of_a_monitor_names_an_input_that_is_missing(watching, rig_fault):
    node, sent, _ = watching
    rows = rig_fault[:300].copy()
    rows[-1, node.ticks.core.inputs.index("stroke")] = np.nan
    tell(node, rows)
    node.timers[0]()
    status = sent[-1][1].status[0]
    assert (status.level, "stroke" in status.message) == (1, True)
    values = {value.key: value.value for value in status.values}
    assert float(values["silent"]) > 0
    assert values["rejected"] == "1"


def test_the_package_of_a_monitor_is_one_that_colcon_builds(watch_package):
    folder = watch_package.parent
    assert "monitor = " in (folder / "setup.py").read_text()
    assert 'executable="monitor"' in (folder / "launch" / "monitor.launch.py").read_text()
    compile((folder / "setup.py").read_text(), "setup.py", "exec")
    for path in watch_package.glob("*.py"):
        compile(path.read_text(), path.name, "exec")
    assert (folder / "config" / "params.yaml").read_text().count('- "') == 5
