"""How long does reading an hour of 25 channels take, from each format, beside the bare call of its library?

Each log holds 25 channels at 100 Hz, written by the library itself where it has a writer. The rival is what a user
would write to get the same 25 columns as arrays. EDP's time holds everything until a recording: checks of the file,
units, time rule, missing values. A second part reads 25 of 128 channels of a log of 4 GB, in parts, in a process of its
own whose peak memory the operating system reports.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import asammdf
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.csv as arrow_csv
import pyarrow.parquet as pq
import scipy.io
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from common import PLACE, Bench, benchmark, table
from edp.logs import WriteOptions, read_recording, write_recording
from edp.logs.formats.matlab.library import matio
from edp.recording import Recording
from edp.signals import Channel, ChannelMap, Kind, SignalMap

CHANNELS = 25
RATE_HZ = 100.0
NAMES = [f"c{i}" for i in range(CHANNELS)]
MAP = SignalMap(tuple(ChannelMap(name, name) for name in NAMES))
GOAL = "<= 2"
KIND = "bench/msg/Sample"
LARGE_LIMIT_MB = 1500.0

Write = Callable[[Path, np.ndarray], Path]
Read = Callable[[Path], list[np.ndarray]]


def values_of(hours: float, channels: int, seed: int) -> np.ndarray:
    """Random walks, shape ``(time, channel)``: neither constant nor as random as noise."""
    rng = np.random.default_rng(seed)
    steps = rng.standard_normal((int(hours * 3600 * RATE_HZ), channels), dtype=np.float32)
    return np.asarray(np.cumsum(steps, axis=0, dtype=np.float64) * 0.01, dtype=np.float32)


def times(values: np.ndarray) -> np.ndarray:
    return np.arange(len(values)) / RATE_HZ


def as_table(values: np.ndarray) -> pa.Table:
    columns = {"time": times(values), **{name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(NAMES)}}
    return pa.table(columns)


def write_csv(path: Path, values: np.ndarray) -> Path:
    arrow_csv.write_csv(as_table(values), path)
    return path


def read_csv(path: Path) -> list[np.ndarray]:
    read = arrow_csv.read_csv(path)
    return [read.column(name).to_numpy() for name in NAMES]


def write_parquet(path: Path, values: np.ndarray) -> Path:
    pq.write_table(as_table(values), path)
    return path


def read_parquet(path: Path) -> list[np.ndarray]:
    read = pq.read_table(path, columns=["time", *NAMES])
    return [read.column(name).to_numpy() for name in NAMES]


def write_mat5(path: Path, values: np.ndarray) -> Path:
    columns = {name: values[:, [i]] for i, name in enumerate(NAMES)}
    scipy.io.savemat(path, {"time": times(values).reshape(-1, 1), **columns}, do_compression=True)
    return path


def read_mat5(path: Path) -> list[np.ndarray]:
    read = scipy.io.loadmat(path)
    return [read[name].ravel() for name in NAMES]


def write_mat73(path: Path, values: np.ndarray) -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        columns = {"time": times(values), **{name: values[:, i] for i, name in enumerate(NAMES)}}
        for name, column in columns.items():
            data = file.create_dataset(name, data=column.reshape(1, -1), compression="gzip", compression_opts=3)
            data.attrs["MATLAB_class"] = np.bytes_(b"double" if column.dtype == np.float64 else b"single")
    with path.open("rb+") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def read_mat73(path: Path) -> list[np.ndarray]:
    with h5py.File(path) as file:
        return [file[name][()].ravel() for name in NAMES]


def writer_of_dataset(version: str) -> Write:
    def write(path: Path, values: np.ndarray) -> Path:
        channels = tuple(Channel(name, Kind.GENERIC) for name in NAMES)
        return write_recording(Recording("R", channels, values, RATE_HZ), path, WriteOptions("dataset", version))

    return write


def read_dataset(path: Path) -> list[np.ndarray]:
    variable = matio.load_from_mat(str(path), variable_names=["log"])["log"]
    storage = variable.properties["any"][0, 0]["Storage"].properties["any"][0, 0]
    return [element.properties["Data_"].ravel() for element in storage["Elements"].ravel()]


def write_mdf(path: Path, values: np.ndarray) -> Path:
    stamps = times(values)
    with asammdf.MDF(version="4.10") as log:
        columns = [np.ascontiguousarray(values[:, i]) for i in range(values.shape[1])]
        log.append([asammdf.Signal(column, stamps, name=f"c{i}") for i, column in enumerate(columns)])
        log.save(path, overwrite=True, compression=2)
    return path


def read_mdf(path: Path) -> list[np.ndarray]:
    with asammdf.MDF(path) as log:
        return [signal.samples for signal in log.select(NAMES)]


def store_of(distribution: Stores) -> Any:
    store = get_typestore(distribution)
    fields = "".join(f"float32 {name}\n" for name in NAMES)
    store.register(get_types_from_msg(f"std_msgs/Header header\n{fields}", KIND))
    return store


def bag_writer(container: str) -> Write:
    """Messages of a header and 25 numbers, as a node would publish them."""

    def write(path: Path, values: np.ndarray) -> Path:
        ros1 = container == "bag"
        store = store_of(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        folder = path.parent / f"{path.name}.folder"
        plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
        kinds, more = store.types, {"seq": 0} if ros1 else {}
        with Writer1(path) if ros1 else Writer2(folder, version=9, storage_plugin=plugin) as writer:
            connection = writer.add_connection("/machine", KIND, typestore=store)
            pack = store.serialize_ros1 if ros1 else store.serialize_cdr
            for k, row in enumerate(values.tolist()):
                at_ns = k * 10_000_000
                stamp = kinds["builtin_interfaces/msg/Time"](sec=at_ns // 10**9, nanosec=at_ns % 10**9)
                header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="base", **more)
                message = kinds[KIND](header, *row)
                writer.write(connection, at_ns, bytes(pack(message, KIND)))
        return path if ros1 else next(folder.glob(f"*.{container}"))

    return write


def bag_reader(container: str) -> Read:
    def read(path: Path) -> list[np.ndarray]:
        ros1 = container == "bag"
        store = store_of(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        rows = []
        with Reader1(path) if ros1 else Reader2(path) as reader:
            for connection, _, raw in reader.messages():
                unpack = store.deserialize_ros1 if ros1 else store.deserialize_cdr
                message = unpack(raw, connection.msgtype)
                rows.append([getattr(message, name) for name in NAMES])
        return list(np.array(rows, dtype=np.float32).T)

    return read


FORMATS: dict[str, tuple[str, Write, Read]] = {
    "CSV": (".csv", write_csv, read_csv),
    "Parquet": (".parquet", write_parquet, read_parquet),
    "MAT v7": (".mat", write_mat5, read_mat5),
    "MAT v7.3": ("_73.mat", write_mat73, read_mat73),
    "Simulink Dataset v7": ("_ds.mat", writer_of_dataset("v5"), read_dataset),
    "Simulink Dataset v7.3": ("_ds73.mat", writer_of_dataset("v7.3"), read_dataset),
    "MDF 4": (".mf4", write_mdf, read_mdf),
    "MCAP": ("_mcap", bag_writer("mcap"), bag_reader("mcap")),
    "ROS 2 bag": ("_db3", bag_writer("db3"), bag_reader("db3")),
    "ROS 1 bag": (".bag", bag_writer("bag"), bag_reader("bag")),
}


def seconds(work: Callable[[], object]) -> float:
    """Return the wall time of a call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def compare(name: str, folder: Path, hours: float, repeats: int, seed: int) -> tuple[float, float, float]:
    """Seconds of EDP and of the library, and the size of the log in MB; both must find the same numbers."""
    suffix, write, bare = FORMATS[name]
    values = values_of(hours, CHANNELS, seed)
    path = write(folder / f"log{suffix}", values)
    read = read_recording(path, MAP)
    theirs = np.stack(bare(path), axis=1).astype(np.float32)
    if read.values.tobytes() != theirs.tobytes() or len(theirs) != len(values):
        raise SystemExit(f"{name}: EDP and the library do not read the same numbers")
    turns = [(seconds(lambda: read_recording(path, MAP)), seconds(lambda: bare(path))) for _ in range(repeats)]
    # The shortest time is what the work takes where nothing else runs.
    ours, library = (min(each) for each in zip(*turns, strict=True))
    return ours, library, path.stat().st_size / 1e6


PEAK = """
import json, sys
from edp.logs import read_parts, read_recording
from edp.signals import ChannelMap, SignalMap
path, channels = sys.argv[1], int(sys.argv[2])
wanted = SignalMap(tuple(ChannelMap(f"c{4 * i}", f"c{4 * i}") for i in range(channels)))
samples, total = 0, 0.0
for part in read_parts(path, wanted):
    samples += part.samples
    total += float(part.values[:, 0].sum(dtype="f8"))
status = open("/proc/self/status").read()
print(json.dumps([int(status.split("VmHWM:")[1].split()[0]) / 1024, samples, total]))
"""


def write_large(path: Path, gigabytes: float, seed: int) -> int:
    """Write a log of 128 float64 channels with the given file size; return its number of samples."""
    channels = 128
    wide = 19 if path.suffix == ".csv" else 8
    samples = int(gigabytes * 1e9 / (wide * channels))
    block = np.random.default_rng(seed).standard_normal((1 << 15, channels)).cumsum(axis=0)
    starts = range(0, samples, len(block))
    blocks = (block[: min(len(block), samples - start)] + start for start in starts)
    stamps = (np.arange(start, min(start + len(block), samples)) / RATE_HZ for start in starts)
    names = [f"c{i}" for i in range(channels)]
    if path.suffix == ".mf4":
        with asammdf.MDF(version="4.10") as log:
            for k, (rows, at) in enumerate(zip(blocks, stamps)):
                if k == 0:
                    log.append([asammdf.Signal(rows[:, i].copy(), at, name=name) for i, name in enumerate(names)])
                else:
                    log.extend(0, [(at, None), *((rows[:, i].copy(), None) for i in range(channels))])
            log.save(path, overwrite=True)
        return samples
    schema = pa.schema([pa.field("time", pa.float64()), *(pa.field(name, pa.float64()) for name in names)])
    with (pq.ParquetWriter if path.suffix == ".parquet" else arrow_csv.CSVWriter)(path, schema) as writer:
        for rows, at in zip(blocks, stamps):
            arrays = [pa.array(at), *(pa.array(np.ascontiguousarray(rows[:, i])) for i in range(channels))]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
    return samples


def peak_of(path: Path) -> tuple[float, float, int]:
    """Peak memory in MB and seconds of reading 25 channels in parts, and the samples read, in a fresh process."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(path), str(CHANNELS)], check=True, capture_output=True, text=True
    )
    peak, samples, _ = json.loads(done.stdout.splitlines()[-1])
    return float(peak), time.perf_counter() - start, int(samples)


@benchmark(PLACE)
def main(bench: Bench) -> object:
    hours, repeats, gigabytes = (0.05, 2, 0.1) if bench.quick else (1.0, 3, 4.0)
    rows, large = [], []
    for name in FORMATS:
        ours, theirs, size = compare(name, bench.folder, hours, repeats, bench.seed)
        rows.append([name, size, ours, theirs, ours / theirs])
        bench.check(f"{name}: {hours:g} h x 25 channels", ours, theirs, GOAL, "s")
    table(["format", "MB", "EDP s", "library s", "ratio"], rows)
    print()
    for suffix in (".mf4", ".parquet", ".csv"):
        path = bench.folder / f"large{suffix}"
        written = write_large(path, gigabytes, bench.seed)
        peak, seconds, samples = peak_of(path)
        if samples != written:
            raise SystemExit(f"{path.name}: {samples} samples read, {written} written")
        large.append([f"{suffix[1:]}, {path.stat().st_size / 1e9:.2f} GB", peak, seconds])
        name = f"peak memory, 25 of 128 channels of {path.stat().st_size / 1e9:.2g} GB {suffix[1:]}"
        bench.check(name, peak, LARGE_LIMIT_MB, "<= 1", "MB")
        path.unlink()
    table(["large log, in parts", "peak MB", "s"], large)
    return {"formats": rows, "large": large}


if __name__ == "__main__":
    main()
