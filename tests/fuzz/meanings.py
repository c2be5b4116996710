"""Files whose bytes are in order and whose meaning is hostile: formulas, links, names, sizes, counts; drawn by a seed.

Each maker takes a generator and a folder and writes one file or folder, of which nothing is known but that reading it
must end in a sound value or in one of EDP's errors.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import asammdf
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io
import tomli_w
from asammdf.blocks.conversion_utils import from_dict
from safetensors.numpy import load_file, save_file

from edp.config.experiment import experiment_toml, load_experiment
from edp.data.features import FeatureSet
from edp.data.task import TargetMode, Task
from edp.logs import WriteOptions, write_recording
from edp.networks.backbones import HybridSpec
from edp.networks.heads import MlpHead
from edp.networks.predictor import ModelSpec, build_model
from edp.recording import Recording
from edp.settings.provenance import Provenance
from edp.signals import TABLE_A1, Channel, Kind
from edp.storage import parse_toml
from edp.training.bundle import HASH, HEADER, Bundle, blank_scaler, content_digest, save_bundle

Rng = np.random.Generator
TIME = np.arange(60) / 100
TEXTS = (
    "", " ", "a", "BmUp", "time", "__import__('os').mkdir('marker')", "=cmd|'/c calc'!A1", "../../etc/passwd",
    "/dev/zero", "[/b]", "a\\[/b]", "</script><script>", "${HOME}", "%s%n%d", "\x00", "\x1b[2J", "\u202egnp", "\udcff",
    "💥", "x" * 300, "x" * 100_000, "nan", "inf", "1e999", "-1", "9" * 6000, "a.b.c", "a\nb", "{{7*7}}",
    "'; DROP TABLE messages; --",
)  # fmt: skip
NUMBERS = (
    0,
    -1,
    1,
    2,
    10**9,
    10**12,
    2**63,
    -(2**63),
    10**30,
    0.0,
    -0.0,
    1e-300,
    1e300,
    float("inf"),
    float("nan"),
    True,
)
FORMULA_PARTS = (
    "X", "X1", "1", "0", "9", "1e308", ".", "+", "-", "*", "/", "^", "**", "(", ")", "sin", "exp", "log", "pow", ",",
    "sqrt(", "9^9^9", "X2", "lambda: 0", "[]", "'", ";", "import os", "__class__", "e", "if", "%", "//",
)  # fmt: skip


def text(rng: Rng) -> str:
    """A hostile text that UTF-8 can hold."""
    return TEXTS[rng.integers(len(TEXTS))].encode("utf-8", "replace").decode()


def value(rng: Rng, depth: int = 0) -> Any:
    """A value of another type or size than any reader waits for."""
    kind = rng.integers(8 if depth < 3 else 4)
    if kind <= 1:
        return text(rng)
    if kind <= 3:
        return NUMBERS[rng.integers(len(NUMBERS))]
    if kind == 4:
        return None
    if kind == 5:
        return [value(rng, depth + 1) for _ in range(rng.integers(4))]
    if kind == 6:
        return {text(rng)[:50]: value(rng, depth + 1) for _ in range(rng.integers(4))}
    nested: Any = 1
    for _ in range(int(rng.choice([5, 100, 200]))):
        nested = [nested]
    return nested


def sites(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Places of the values in a tree of dictionaries and lists, down to a dozen levels."""
    if len(path) > 12:
        return []
    below = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path] * bool(path) + [site for key, part in below for site in sites(part, (*path, key))]


def changed(tree: Any, rng: Rng) -> Any:
    """A copy of a tree in which some values are replaced, removed or doubled."""
    tree = json.loads(json.dumps(tree))
    for _ in range(int(rng.integers(1, 4))):
        places = sites(tree)
        if not places:
            return tree
        *above, last = places[rng.integers(len(places))]
        holder = tree
        for key in above:
            holder = holder[key]
        if rng.integers(4) == 0:
            del holder[last]
        elif rng.integers(6) == 0 and isinstance(holder, dict):
            holder[text(rng)[:80]] = value(rng)
        else:
            holder[last] = value(rng)
    return tree


def recording(rng: Rng) -> Recording:
    names = ("BmUp", "CylVels_1")
    channels = (*(TABLE_A1[name] for name in names), Channel("Extra", Kind.GENERIC))
    values = rng.standard_normal((60, 3)).astype(np.float32)
    return Recording("R1", channels, values, 100.0, "sim:fuzz", {"seed": 1})


def mdf(rng: Rng, folder: Path) -> Path:
    """Formulas drawn from the grammar and beside it, hostile names and tables of conversions."""
    path = folder / "log.mf4"
    formula = "".join(rng.choice(FORMULA_PARTS, int(rng.integers(1, 40))))
    tables: list[dict[str, Any]] = [
        {"formula": formula},
        {"val_0": 0, "text_0": text(rng), "default": text(rng)},
        {"lower_0": 1.0, "upper_0": -1.0, "text_0": text(rng), "default": b""},
        {"raw_0": float("nan"), "phys_0": float("inf"), "raw_1": 0.0, "phys_1": 1.0},
        {f"P{i}": float(rng.choice([0.0, 1.0, 1e308, np.inf])) for i in range(1, 7)},
        {"a": float("nan"), "b": 1e308},
    ]
    with asammdf.MDF(version="4.10") as log:
        conversion = from_dict(tables[rng.integers(len(tables))])
        name = "BmUp" if rng.integers(4) else text(rng)[:60_000]
        log.append(
            [asammdf.Signal(TIME, TIME, name=name, unit=text(rng)[:200], comment=text(rng), conversion=conversion)]
        )
        log.append([asammdf.Signal(TIME, TIME[:: rng.choice([1, -1])].copy(), name="CylVels_1")], comment=text(rng))
        if rng.integers(4) == 0:
            log.attach(json.dumps(value(rng)).encode(), file_name="edp_info.json", mime="application/json")
        log.save(path, overwrite=True)
    return path


def mat(rng: Rng, folder: Path) -> Path:
    """Arrays of odd shapes and types, nested structs and cells, texts where numbers are waited for."""
    path = folder / "log.mat"

    def part(depth: int = 0) -> Any:
        kind = rng.integers(8)
        if kind == 0 and depth < 5:
            return {f"f{i}": part(depth + 1) for i in range(rng.integers(1, 4))}
        if kind == 1:
            return np.array([part(depth + 1) if depth < 3 else 1.0 for _ in range(3)], dtype=object)
        if kind == 2:
            return text(rng)[:2000].replace("\x00", "")
        if kind == 3:
            return np.zeros(tuple(rng.integers(0, 4, int(rng.integers(1, 6)))))
        if kind == 4:
            return TIME * (1 + 1j)
        return [TIME, TIME[::-1], np.full(60, np.nan), np.arange(60, dtype=np.int8), TIME > 0.2][rng.integers(5)]

    info = {} if rng.integers(4) else {"edp_info": text(rng).replace("\x00", "")}
    scipy.io.savemat(
        path,
        {
            "t": TIME,
            "BmUp": part(),
            "CylVels_1": part(),
        }
        | info,
    )
    return path


def mat73(rng: Rng, folder: Path) -> Path:
    """Links, references, storage elsewhere, and attributes that are not what they say."""
    path = Path(write_recording(recording(rng), folder / "log73.mat", WriteOptions(mat_version="v7.3")))
    elsewhere = str(rng.choice([str(folder / "other"), "/etc/hostname", "/dev/zero", str(path)]))
    with h5py.File(path, "r+") as file:
        way = rng.integers(7)
        if way == 0:
            file["stolen"] = h5py.ExternalLink(elsewhere, "/x")
        elif way == 1:
            file.create_dataset("raw", shape=(8,), dtype="f8", external=[(elsewhere, 0, 64)])
        elif way == 2:
            layout = h5py.VirtualLayout(shape=(8,), dtype="f8")
            layout[:] = h5py.VirtualSource(elsewhere, "x", shape=(8,))
            file.create_virtual_dataset("virtual", layout)
        elif way == 3:
            group = file
            for _ in range(int(rng.choice([3, 200]))):
                group = group.create_group("g")
            group["loop"] = file["/"]
        elif way == 4:
            made = file.create_dataset("lies", data=rng.integers(0, 9, 6))
            made.attrs["MATLAB_class"] = np.bytes_(
                str(rng.choice(["cell", "char", "struct", "table", "function_handle"]))
            )
            made.attrs["MATLAB_empty"] = int(rng.integers(3))
        elif way == 5:
            shape = tuple(int(size) for size in rng.choice([1, 1000, 100_000], 2))
            file.create_dataset("wide", shape=shape, dtype="f8", chunks=(1, 1000) if shape[1] >= 1000 else None)
        else:
            info = file.create_dataset(
                "odd", data=np.frombuffer(text(rng)[:500].encode("utf-16-le") + b"  ", np.uint16)
            )
            info.attrs["MATLAB_class"] = np.bytes_("char")
    return path


def parquet(rng: Rng, folder: Path) -> Path:
    """Metadata that lies, names that repeat, nested and packed columns."""
    path = folder / "log.parquet"
    columns: list[Any] = [
        TIME, np.zeros(60), [[1.0, 2.0]] * 60, [{"a": 1.0}] * 60, [text(rng)[:500]] * 60, [None] * 60,
        pa.array([True] * 60), pa.array([b"x"] * 60), pa.array(TIME.astype("f4")).dictionary_encode(),
        pa.array([2**62] * 60, pa.timestamp("ns")), pa.array([[[[1.0]]]] * 60),
    ]  # fmt: skip
    metadata = {
        "unit": text(rng),
        "kind": text(rng),
        "ARROW:extension:name": text(rng),
        "ARROW:extension:metadata": "x",
    }
    fields, arrays = [pa.field("time", pa.float64())], [pa.array(TIME)]
    for _ in range(int(rng.integers(1, 5))):
        array = columns[rng.integers(len(columns))]
        arrays.append(array if isinstance(array, pa.Array) else pa.array(array))
        name = str(rng.choice(["BmUp", "CylVels_1", "time"])) if rng.integers(2) else text(rng)[:60_000]
        fields.append(pa.field(name, arrays[-1].type, metadata=metadata if rng.integers(2) else None))
    about = {key: json.dumps(value(rng)).encode() for key in (b"edp_info", b"pandas", b"edp") if rng.integers(2)}
    pq.write_table(pa.table(arrays, schema=pa.schema(fields, metadata=about)), path)
    return path


def own_parquet(rng: Rng, folder: Path) -> Path:
    """A table of EDP whose facts are changed."""
    path = Path(write_recording(recording(rng), folder / "own.parquet"))
    table = pq.read_table(path)
    metadata = dict(table.schema.metadata or {})
    for key, data in list(metadata.items()):
        try:
            metadata[key] = json.dumps(changed(json.loads(data), rng)).encode()
        except (ValueError, IndexError, TypeError):
            metadata[key] = text(rng).encode()
    pq.write_table(table.replace_schema_metadata(metadata), path)
    return path


def csv(rng: Rng, folder: Path) -> Path:
    """Cells, quotes, marks, encodings and dates that no logger writes."""
    path = folder / "log.csv"
    cells = [*TEXTS, "1,5", "1.5", "2026-01-01 00:00:00", "31.12.9999", '"', '""', "'", "\t", "1e400", "0x10", "٣", "½"]
    delimiter = str(rng.choice([",", ";", "\t", "|"]))
    width, share = int(rng.choice([1, 2, 3, 200])), float(rng.choice([0.0, 0.02, 0.3]))
    honest = ["time", "BmUp", "CylVels_1 [mm/s]", *(f"c{column}" for column in range(3, width))][:width]
    head = [name if rng.random() >= share else text(rng) for name in honest]
    rows = [head]
    for row in range(30):
        count = width + int(rng.choice([0, 0, 0, 1, -1])) * (share > 0)
        rows.append([str(row / 100) if rng.random() >= share else str(rng.choice(cells)) for _ in range(max(0, count))])
    body = str(rng.choice(["\n", "\r\n", "\r"])).join(delimiter.join(row) for row in rows)
    start = str(rng.choice(["", "sep=;\n", "# " + "c" * 300_000 + "\n", "\n\n\n", '"', "\ufeff\ufeff"]))
    codec = str(rng.choice(["utf-8", "utf-16", "utf-16-be", "cp1252", "utf-32"]))
    path.write_bytes((start + body).encode(codec, "replace"))
    return path


def bag(rng: Rng, folder: Path) -> Path:
    """Definitions of messages with other fields in them, names of topics and types, tables that are not a bag's."""
    suffix = str(rng.choice([".mcap", ".db3", ".bag"]))
    path = Path(write_recording(recording(rng), folder / f"log{suffix}"))
    if suffix == ".db3" and rng.integers(2):
        with sqlite3.connect(path) as base:
            tables = [row[0] for row in base.execute("select name from sqlite_master where type = 'table'")]
            table = str(rng.choice(tables))
            for statement in (
                f"update {table} set rowid = rowid",
                "create view v as select * from v",
                "create trigger t after insert on messages begin select load_extension('x'); end",
                f"alter table {table} add column extra text default 'x'",
                "update messages set timestamp = 'abc'",
                "update messages set data = zeroblob(100000000)"
                if rng.integers(8) == 0
                else "update messages set data = null",
                "update topics set type = 'a/msg/B'",
                "update topics set name = '" + text(rng)[:100].replace("'", "").replace("\x00", "") + "'",
            ):
                if rng.integers(3) == 0:
                    try:
                        base.execute(statement)
                    except sqlite3.Error:
                        continue
        return path
    data = path.read_bytes()
    swaps = [(b"float32", b"float64"), (b"float32", b"string "), (b"float32 B", b"uint8[9] "), (b"/edp/", b"/../."),
             (b"std_msgs", b"__init__"), (b"Header", b"eval()"), (b"int32 sec", b"int32[]se"),
             (b"cdr", b"xml")]  # fmt: skip
    for old, new in swaps:
        if rng.integers(3) == 0:
            data = data.replace(old, new)
    path.write_bytes(data)
    return path


def bag_folder(rng: Rng, folder: Path) -> Path:
    """A ROS 2 bag whose description names other files, or is none."""
    bag_path = folder / "bag"
    bag_path.mkdir()
    write_recording(recording(rng), bag_path / "bag_0.db3")
    files = ["bag_0.db3", "../../../etc/passwd", "/dev/zero", "bag_0.db3"]
    relative = [str(name) for name in rng.choice(files, int(rng.integers(1, 3)))]
    about: Any = {"rosbag2_bagfile_information": {
        "version": value(rng) if rng.integers(2) else 5,
        "storage_identifier": str(rng.choice(["sqlite3", "mcap", "x"])),
        "relative_file_paths": relative, "duration": {"nanoseconds": value(rng)}, "message_count": value(rng),
        "starting_time": {"nanoseconds_since_epoch": 0}, "compression_format": str(rng.choice(["", "zstd", "x"])),
        "compression_mode": str(rng.choice(["", "FILE", "MESSAGE"])), "topics_with_message_count": [value(rng)],
    }}  # fmt: skip
    anchors = "a: &a [x]\nb: &b [*a,*a,*a,*a]\nc: [*b,*b,*b]\n!!python/object/apply:os.mkdir ['marker']: 1\n"
    body = anchors if rng.integers(4) == 0 else json.dumps(changed(about, rng), allow_nan=True)
    (bag_path / "metadata.yaml").write_text(body)
    return bag_path


def _bundle(folder: Path) -> Path:
    """An honest bundle, made once."""
    path = folder / "honest_bundle"
    if not path.is_dir():
        names = ("lever", "pressure", "speed")
        task = Task(FeatureSet("own", names), ("speed",), (1, 5), TargetMode.DELTA, 100.0)
        spec = ModelSpec(backbone=HybridSpec(channels=(4,), kernel=2, units=4), head=MlpHead(hidden=4), window=8)
        predictor = build_model(task, spec, blank_scaler(task), seed=1).eval()
        inputs = tuple(Channel(name, Kind.GENERIC) for name in names)
        save_bundle(Bundle(predictor, inputs, (Kind.VELOCITY,), ("how fast",), Provenance(seconds=1.0), {}), path)
    return path


def bundle(rng: Rng, folder: Path) -> Path:
    """A header with other values, mostly with a hash that fits them; other weights; a pipe in place of either."""
    path = folder / "bundle"
    shutil.copytree(_bundle(folder), path)
    header = json.loads((path / HEADER).read_text())
    way = rng.integers(8)
    if way <= 5:
        new = changed(header, rng)
        if isinstance(new, dict) and rng.integers(6):
            try:
                new[HASH] = content_digest(new)
            except ValueError:
                new[HASH] = "0"
        (path / HEADER).write_text(json.dumps(new))
    elif way == 6:
        weights = next(path.glob("*.safetensors"))
        tensors = load_file(weights)
        name = str(rng.choice(sorted(tensors)))
        odd = [np.full_like(tensors[name], np.nan), tensors[name][:0], tensors[name].astype("f8"), np.zeros((3, 3, 3))]
        save_file(tensors | {name: odd[rng.integers(4)]}, weights)
    else:
        target = path / HEADER if rng.integers(2) else next(path.glob("*.safetensors"))
        target.unlink()
        os.mkfifo(target)
    return path


def settings(rng: Rng, folder: Path) -> Path:
    """Settings of an experiment with other values."""
    return _toml(rng, folder / "settings.toml", parse_toml(experiment_toml(load_experiment(None, "quick")), "settings"))


def signal_map(rng: Rng, folder: Path) -> Path:
    """A signal map with other values."""
    plain = {
        "time": "t", "time_unit": "ms", "rate_hz": 100.0, "delimiter": ";", "columns": ["a", "b"], "others": True,
        "channels": {"BmUp": {"column": "a", "unit": "bar", "scale": 1.0}, "X": {"constant": 0.0, "kind": "force"}},
    }  # fmt: skip
    return _toml(rng, folder / "map.toml", plain)


def _toml(rng: Rng, path: Path, plain: dict[str, Any]) -> Path:
    def writable(tree: Any) -> Any:
        if isinstance(tree, dict):
            return {str(key): writable(part) for key, part in tree.items() if part is not None}
        if isinstance(tree, list):
            return [writable(part) for part in tree if part is not None]
        return tree

    path.write_text(tomli_w.dumps(writable(changed(plain, rng))), encoding="utf-8", errors="replace")
    return path


MAKERS: dict[str, Callable[[Rng, Path], Path]] = {
    maker.__name__: maker
    for maker in (mdf, mat, mat73, parquet, own_parquet, csv, bag, bag_folder, bundle, settings, signal_map)
}
