"""Bags and MCAP files written by rosbags itself, read by EDP."""

from __future__ import annotations

import sqlite3

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edp.errors import DataError
from edp.logs import FORMATS, find_recordings, inspect_log, read_data_set, read_recording, write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1, ChannelMap, Kind, SignalMap

pytestmark = pytest.mark.processes

CONTAINERS = ("mcap", "db3", "bag")
STEP_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000


class Bag:
    """A bag that is being written: `put(topic, type, time, **fields)`."""

    def __init__(self, folder, container, name="drive"):
        self.container = container
        self.store = get_typestore(Stores.ROS1_NOETIC if container == "bag" else Stores.ROS2_HUMBLE)
        self.topics = {}
        if container == "bag":
            self.path = folder / f"{name}.bag"
            self.writer = Writer1(self.path)
        else:
            self.path = folder / name
            plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self.writer.open()

    def put(self, topic, kind, at_ns, **fields):
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.store.types[kind](**fields)
        pack = self.store.serialize_ros1 if self.container == "bag" else self.store.serialize_cdr
        self.writer.write(self.topics[topic], at_ns, bytes(pack(message, kind)))

    def header(self, at_ns, frame="base"):
        kinds = self.store.types
        stamp = kinds["builtin_interfaces/msg/Time"](sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        more = {"seq": 0} if self.container == "bag" else {}
        return kinds["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def close(self):
        self.writer.close()
        return self.path

    def file(self):
        self.close()
        return self.path if self.container == "bag" else next(self.path.glob(f"*.{self.container}"))


def drive(folder, container, samples=100, name="drive"):
    """A velocity at 100 Hz with texts of changing length between, joints by name, a command with a header."""
    bag = Bag(folder, container, name)
    for k in range(samples):
        at = START_NS + k * STEP_NS
        bag.put("/front/CylVels_1", "std_msgs/msg/Float64", at, data=0.01 * k)
        bag.put("/note", "std_msgs/msg/String", at, data="x" * (k % 7))
        joints = {"name": ["boom", "arm"], "position": np.array([k, 2.0 * k]), "velocity": np.array([0.1 * k, -k])}
        bag.put("/joints", "sensor_msgs/msg/JointState", at, header=bag.header(at), effort=np.zeros(0), **joints)
    return bag


@pytest.mark.parametrize("container", CONTAINERS)
def test_topics_become_columns(tmp_path, container):
    path = drive(tmp_path, container).file()
    wanted = SignalMap(
        (
            ChannelMap("v", "/front/CylVels_1.data", "m/s", Kind.VELOCITY),
            ChannelMap("boom", "position.boom", "rad", Kind.ANGLE),
            ChannelMap("arm", "/joints.velocity.arm", "rad/s", Kind.ANGULAR_VELOCITY),
        )
    )
    read = read_recording(path, wanted)
    k = np.arange(100)
    assert read.rate_hz == 100.0
    np.testing.assert_allclose(read.values, np.stack([0.01 * k, k, -k], axis=1), rtol=1e-6)
    # A topic that holds nothing but data goes by its own name.
    assert read_recording(path).channel_names == ("CylVels_1",)
    assert read_recording(path, wanted, rows=(20, 30)).values.tobytes() == read.values[20:30].tobytes()


@pytest.mark.parametrize("container", ["mcap", "db3"])
def test_a_bag_folder_is_one_log(tmp_path, container):
    folder = drive(tmp_path, container).close()
    assert find_recordings(tmp_path) == (folder,)
    assert find_recordings(folder) == (folder,)
    assert read_recording(folder).samples == 100
    assert inspect_log(folder).name == "drive"


def test_a_folder_of_mixed_formats_is_one_data_set(tmp_path):
    channels = (TABLE_A1["CylVels_1"],)
    values = np.zeros((50, 1), dtype=np.float32)
    suffixes = [part.suffixes[0][1:] for part in FORMATS.values()]
    for suffix in suffixes:
        write_recording(Recording(suffix, channels, values, 100.0), tmp_path / f"{suffix}.{suffix}")
    drive(tmp_path, "mcap", name="folder").close()
    read = read_data_set(tmp_path)
    assert [recording.name for recording in read] == sorted([*suffixes, "folder"])
    assert {recording.channel_names for recording in read} == {("CylVels_1",)}
    assert {recording.rate_hz for recording in read} == {100.0}


@pytest.mark.parametrize("container", CONTAINERS)
def test_time_is_that_of_the_headers_unless_the_map_wants_the_log(tmp_path, container):
    bag = Bag(tmp_path, container)
    for k in range(50):
        measured = START_NS + k * 20_000_000
        late = measured + 5_000_000 * (k % 3)
        vector = bag.store.types["geometry_msgs/msg/Vector3"](x=float(k), y=0.0, z=0.0)
        bag.put("/force", "geometry_msgs/msg/Vector3Stamped", late, header=bag.header(measured), vector=vector)
    path = bag.file()
    wanted = (ChannelMap("F", "vector.x", "N", Kind.FORCE),)
    read = read_recording(path, SignalMap(wanted))
    assert (read.rate_hz, read.samples) == (50.0, 50)
    assert "resampled_from_hz" not in read.meta
    assert "resampled_from_hz" in read_recording(path, SignalMap(wanted, time="log_time")).meta
    with pytest.raises(DataError, match=r"no time column 'stamp'; in a bag 'time'.*'header.stamp' or 'log_time'"):
        read_recording(path, SignalMap(wanted, time="stamp"))


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_header_clock_that_runs_backwards_is_refused(tmp_path, container):
    bag = Bag(tmp_path, container)
    for k in range(40):
        stamp = START_NS + (k if k < 20 else k - 15) * STEP_NS
        vector = bag.store.types["geometry_msgs/msg/Vector3"](x=float(k), y=0.0, z=0.0)
        at = START_NS + k * STEP_NS
        bag.put("/force", "geometry_msgs/msg/Vector3Stamped", at, header=bag.header(stamp), vector=vector)
    with pytest.raises(DataError, match=r"time goes back in 1 row\(s\), first in row 20"):
        read_recording(bag.file(), SignalMap((ChannelMap("F", "vector.x"),)))


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_bag_without_the_topic_offers_the_closest(tmp_path, container):
    path = drive(tmp_path, container).file()
    with pytest.raises(DataError, match=r"no column 'position.bom'; did you mean 'position.boom'\?"):
        read_recording(path, SignalMap((ChannelMap("b", "position.bom"),)))
    bag = Bag(tmp_path, container, "texts")
    bag.put("/note", "std_msgs/msg/String", START_NS, data="x")
    with pytest.raises(DataError, match=r"no numbers in messages \(topics: /note\)"):
        read_recording(bag.file())
    bag = Bag(tmp_path, container, "none")
    bag.writer.add_connection("/pressure", "std_msgs/msg/Float64", typestore=bag.store)
    with pytest.raises(DataError, match=r"holds no numbers in messages \(topics: (/pressure|none)\)"):
        read_recording(bag.file())


@pytest.mark.parametrize("container", CONTAINERS)
def test_two_topics_with_one_field_are_told_apart(tmp_path, container):
    bag = Bag(tmp_path, container)
    for k in range(10):
        for side in ("left", "right"):
            bag.put(
                f"/{side}/BmUp", "std_msgs/msg/Float32", START_NS + k * STEP_NS, data=1.0 if side == "left" else 2.0
            )
    path = bag.file()
    with pytest.raises(DataError, match=r"2 columns named 'BmUp': /left/BmUp.data, /right/BmUp.data"):
        read_recording(path)
    read = read_recording(path, SignalMap((ChannelMap("BmUp", "/right/BmUp.data"),)))
    assert set(read.values.ravel().tolist()) == {2.0}


@pytest.mark.parametrize("container", CONTAINERS)
def test_lists_types_of_ones_own_and_large_messages(tmp_path, container):
    bag = Bag(tmp_path, container)
    text = "uint8 id\nfloat64 oil\nbool on\nfloat32[4] p\nstring who\nint16 last\nfloat64[] many\n"
    bag.store.register(get_types_from_msg(text, "rig/msg/State"))
    for k in range(300):
        fields = {"id": k % 256, "oil": 0.5 * k, "on": k % 2 == 0, "last": -k, "who": "ab"[: k % 3]}
        fields |= {"p": np.arange(4, dtype=np.float32) + k, "many": np.zeros(1000)}
        bag.put("/state", "rig/msg/State", START_NS + k * STEP_NS, **fields)
    path = bag.file()
    columns = ("id", "oil", "on", "p_1", "p_4", "last")
    read = read_recording(path, SignalMap(tuple(ChannelMap(name, name) for name in columns)))
    k = np.arange(300)
    expected = np.stack([k % 256, 0.5 * k, k % 2 == 0, k, 3 + k, -k], axis=1)
    np.testing.assert_array_equal(read.values, expected.astype(np.float32))
    with pytest.raises(DataError, match="no column 'many_1'"):
        read_recording(path, SignalMap((ChannelMap("m", "many_1"),)))


@pytest.mark.parametrize("container", CONTAINERS)
def test_topics_are_read_in_pieces_where_they_are_large(tmp_path, container, monkeypatch):
    path = drive(tmp_path, container).file()
    whole = read_recording(path)
    monkeypatch.setattr("edp.logs.formats.rosbag.KEPT_BYTES", 0)
    monkeypatch.setattr("edp.logs.formats.rosbag.PIECE_ROWS", 16)
    assert read_recording(path).values.tobytes() == whole.values.tobytes()
    assert read_recording(path, rows=(33, 70)).values.tobytes() == whole.values[33:70].tobytes()


def test_lists_that_grow_and_names_that_change_places(tmp_path):
    bag = Bag(tmp_path, "mcap")
    for k in range(6):
        names = ["boom", "arm"] if k % 2 else ["arm", "boom"]
        position = np.array([1.0, 2.0] if k % 2 else [2.0, 1.0])
        at = START_NS + k * STEP_NS
        more = {"velocity": np.arange(float(k % 3)), "effort": np.zeros(0)}
        bag.put(
            "/joints", "sensor_msgs/msg/JointState", at, header=bag.header(at), name=names, position=position, **more
        )
    path = bag.file()
    read = read_recording(path, SignalMap((ChannelMap("b", "position.boom"), ChannelMap("a", "position.arm"))))
    np.testing.assert_array_equal(read.values, [[1.0, 2.0]] * 6)


def test_files_that_cannot_be_read_say_why(tmp_path):
    path = drive(tmp_path, "bag").file()
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"index_pos=", b"encryptor=", 1))
    with pytest.raises(DataError, match="cannot be read"):
        read_recording(path)
    place = whole.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(whole[:place] + bytes(8) + whole[place + 8 :])
    with pytest.raises(DataError, match="run 'rosbag reindex'"):
        read_recording(path)
    mcap = drive(tmp_path, "mcap", name="m").file()
    whole = mcap.read_bytes()
    mcap.write_bytes(whole.replace(b"\x04\x00\x00\x00ros2", b"\x04\x00\x00\x00ros1", 1))
    with pytest.raises(DataError, match="only ROS 2 messages in MCAP are read"):
        read_recording(mcap)
    mcap.write_bytes(whole[:-500])
    with pytest.raises(DataError, match="truncated, half downloaded, or its recorder was killed"):
        read_recording(mcap)
    other = tmp_path / "other.db3"
    with sqlite3.connect(other) as base:
        base.execute("CREATE TABLE t (a INTEGER)")
    base.close()
    with pytest.raises(DataError, match="missing tables"):
        read_recording(other)
    folder = drive(tmp_path, "db3", name="gone").close()
    next(folder.glob("*.db3")).unlink()
    with pytest.raises(DataError, match="database files are missing"):
        read_recording(folder)


def plan(bag, topic="/plan"):
    """A message that holds a whole plan of a motion, as planners publish it."""
    kinds = bag.store.types
    point = kinds["trajectory_msgs/msg/JointTrajectoryPoint"]
    span = kinds["builtin_interfaces/msg/Duration"](sec=1, nanosec=0)
    one = point(
        positions=np.zeros(3),
        velocities=np.zeros(3),
        accelerations=np.zeros(3),
        effort=np.zeros(0),
        time_from_start=span,
    )
    fields = {"header": bag.header(START_NS), "joint_names": ["a", "b", "c"], "points": [one] * 12_000}
    bag.put(topic, "trajectory_msgs/msg/JointTrajectory", START_NS, **fields)


def test_a_plan_beside_sensors_is_passed_over(tmp_path):
    bag = Bag(tmp_path, "db3")
    plan(bag)
    for k in range(50):
        bag.put("/p", "std_msgs/msg/Float64", START_NS + k * STEP_NS, data=float(k))
    assert read_recording(bag.file(), SignalMap(others=True)).channel_names == ("p",)


def test_a_bag_of_nothing_but_a_plan_says_so(tmp_path):
    bag = Bag(tmp_path, "db3")
    plan(bag)
    with pytest.raises(DataError, match="is a list of many numbers, such as a plan"):
        read_recording(bag.file(), SignalMap(others=True))
