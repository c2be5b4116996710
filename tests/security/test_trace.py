"""What Python does while files with hostile meanings are read: it runs and compiles nothing, starts nothing, opens only
the file, and the marker that every one of them would leave does not appear."""

from __future__ import annotations

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import asammdf
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import torch
from asammdf.blocks.conversion_utils import from_dict
from safetensors.numpy import save_file

from edp.logs import FORMATS, WriteOptions, write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind

WORKER = Path(__file__).with_name("trace_worker.py")
TIME = np.arange(60) / 100


class Marked:
    """Unpickling it makes a file."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (self.path,)


class Corpus:
    """Files with hostile meanings, each of which would make `marker` if a text or a pickle in it were run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.marker = folder, folder.parent / "marker"
        self.code = f"__import__('os').mkdir({str(self.marker)!r})"
        self.pickled = pickle.dumps(Marked(str(self.marker)))
        folder.mkdir()
        (folder / "other.txt").write_text("secret")
        for build in (self.honest, self.mdf, self.mat, self.parquet, self.csv, self.bags, self.ours):
            build()

    def file(self, name: str) -> Path:
        return self.folder / name

    def recording(self, extra: str = "Extra", source: str = "sim:trace") -> Recording:
        channels = (*(TABLE_A1[name] for name in ("BmUp", "CylVels_1")), Channel(extra, Kind.GENERIC, extra))
        values = np.random.default_rng(0).standard_normal((60, 3)).astype(np.float32)
        return Recording("R1", channels, values, 100.0, source, {"note": extra})

    def honest(self) -> None:
        for part in FORMATS.values():
            write_recording(self.recording(), self.file(f"honest{part.suffixes[0]}"))
        for version in ("v5", "v7.3"):
            for layout in ("struct", "dataset"):
                name = f"honest_{layout}_{version.replace('.', '')}.mat"
                write_recording(self.recording(), self.file(name), WriteOptions(layout, version))
        self.formula("honest_formula.mf4", "X1*0.001+2")
        pq.write_table(pa.table({"time": TIME, "BmUp": TIME}), self.file("honest_foreign.parquet"))
        rows = "".join(f"{t},{'on' if t < 0.1 else 'off'}\n" for t in TIME)
        self.file("honest_switch.csv").write_text(f"time,BmUp\n{rows}")
        scipy.io.savemat(self.file("honest_foreign.mat"), {"t": TIME, "BmUp": TIME, "s": {"time": TIME, "y": TIME}})
        self.file("honest_settings.toml").write_text("[training]\nepochs = 2\n")
        self.file("honest_map.toml").write_text("time = 't'\n[channels.BmUp]\ncolumn = 'a'\n")

    def formula(self, name: str, formula: str) -> None:
        conversion = from_dict({"formula": formula})
        with asammdf.MDF(version="4.10") as log:
            log.append([asammdf.Signal(TIME, TIME, name="BmUp", conversion=conversion)])
            log.save(self.file(name), overwrite=True)

    def mdf(self) -> None:
        self.formula("code.mf4", f"X1+0*len(repr({self.code}))")
        self.formula("tower.mf4", "X1+9**9**9**9")
        with asammdf.MDF(version="4.10") as log:
            text = from_dict({"val_0": 0, "text_0": self.code, "default": self.code})
            log.append([asammdf.Signal(TIME, TIME, name=self.code, unit=self.code, comment=self.code, conversion=text)])
            log.append([asammdf.Signal(TIME, TIME, name="BmUp")], comment=self.code, acq_name=self.code)
            log.attach(self.pickled, file_name=f"../../{self.marker.name}", mime="application/python-pickle")
            log.attach(self.code.encode(), file_name="edp_info.json", mime="application/json")
            log.save(self.file("names.mf4"), overwrite=True)

    def mat(self) -> None:
        for name, path in (("structure.mat", "honest_struct_v73.mat"),):
            self.file(name).write_bytes(self.file(path).read_bytes())
        with h5py.File(self.file("structure.mat"), "r+") as file:
            file["stolen"] = h5py.ExternalLink(str(self.file("other.txt")), "/x")
            file.create_dataset("raw", shape=(6,), dtype="u1", external=[(str(self.file("other.txt")), 0, 6)])
            code = file.create_dataset("run", data=np.frombuffer(self.code.encode("utf-16-le"), np.uint16))
            code.attrs["MATLAB_class"] = np.bytes_("function_handle")
        scipy.io.savemat(
            self.file("text.mat"), {"BmUp": TIME, "t": TIME, "run": self.code, "c": np.array([self.code], object)}
        )
        scipy.io.savemat(self.file("info.mat"), {"BmUp": TIME, "edp_info": self.code})

    def parquet(self) -> None:
        table = pa.table({"time": TIME, "BmUp": TIME})
        hostile = {b"pandas": self.code.encode(), b"edp_info": self.code.encode(), b"ARROW:schema": self.pickled}
        pq.write_table(table.replace_schema_metadata(hostile), self.file("metadata.parquet"))
        # What pyarrow before 14.0.1 unpickled when it met it.
        extension = {"ARROW:extension:name": "arrow.py_extension_type", "ARROW:extension:metadata": self.pickled}
        fields = [pa.field("time", pa.float64()), pa.field("BmUp", pa.float64(), metadata=extension)]
        pq.write_table(pa.table([TIME, TIME], schema=pa.schema(fields)), self.file("extension.parquet"))
        names = pa.table({"time": TIME, self.code: TIME, f"BmUp [{self.code}]": TIME})
        pq.write_table(names, self.file("names.parquet"))

    def csv(self) -> None:
        rows = "\n".join(f"{t},{self.code},=cmd|'/c calc'!A1" for t in TIME)
        self.file("formulas.csv").write_text(f'time,"{self.code}","=HYPERLINK(""x"")"\n{rows}\n')
        self.file("names.csv").write_text(f"time,BmUp [{self.code}]\n" + "\n".join(f"{t},1" for t in TIME))

    def bags(self) -> None:
        for suffix in (".mcap", ".db3", ".bag"):
            data = self.file(f"honest{suffix}").read_bytes()
            # The same length, so that only the meaning changes: a field's name becomes the start of other code.
            for old in (b"float32 BmUp", b"BmUp"):
                if old in data:
                    self.file(f"definition{suffix}").write_bytes(
                        data.replace(old, b"#\n\nx=1;y=2;z"[: len(old)].ljust(len(old)))
                    )
                    break

    def ours(self) -> None:
        self.file("settings.toml").write_text(
            f'[task]\nfeatures = "{self.file("other.txt")}"\ntargets = ["{self.code}"]\n'
        )
        self.file("settings_kind.toml").write_text(f'[model.backbone]\nkind = "{self.code}"\n')
        self.file("map.toml").write_text(f'time = "{self.code}"\n[channels.BmUp]\nunit = "{self.code}"\n')
        data = io.BytesIO()
        np.save(data, np.array([Marked(str(self.marker))], dtype=object), allow_pickle=True)
        with zipfile.ZipFile(self.file("objects.npz"), "w") as packed:
            packed.writestr("facts.npy", data.getvalue())
        for name, weights in (("pickle", None), ("tensors", {"x": np.zeros(1)})):
            bundle = self.file(f"bundle_{name}")
            bundle.mkdir()
            (bundle / "bundle.json").write_text(
                json.dumps({"schema": 4, "task": self.code, "weights": "weights.safetensors"})
            )
            path = bundle / "weights.safetensors"
            torch.save(Marked(str(self.marker)), path) if weights is None else save_file(weights, path)


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> tuple[Corpus, dict[str, dict[str, object]]]:
    corpus = Corpus(tmp_path_factory.mktemp("trace") / "files")
    command = [sys.executable, str(WORKER), str(corpus.folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, cwd=corpus.folder.parent)
    assert done.returncode == 0, done.stderr[-3000:]
    return corpus, json.loads(done.stdout.splitlines()[-1])


def test_honest_files_are_read(traced):
    _, found = traced
    ends = {name: end for name, end in found["ends"].items() if name.startswith("honest")}
    assert len(ends) >= 14
    assert set(ends.values()) == {"read"}


def test_hostile_files_run_nothing_and_open_nothing_else(traced):
    corpus, found = traced
    assert len(found["events"]) >= 18
    assert {name: events for name, events in found["events"].items() if events} == {}
    assert not corpus.marker.exists()


def test_what_no_reader_takes_ends_in_a_message(traced):
    _, found = traced
    refused = (
        "code.mf4",
        "structure.mat",
        "info.mat",
        "objects.npz",
        "bundle_pickle",
        "settings_kind.toml",
    )
    for name in refused:
        assert "Error: " in found["ends"][name], name


TRAPS: dict[str, Callable[[str], str]] = {
    "evaluated text": lambda _: "eval('1 + 1')",
    "unpickled": lambda _: "__import__('pickle').loads(b'cos\\ngetcwd\\n(tR.')",
    "a program": lambda _: "__import__('subprocess').run(['true'])",
    "a socket": lambda _: "__import__('socket').socket()",
    "another file": lambda _: "open('/etc/hostname').read()",
    "a file written": lambda marker: f"open({marker!r}, 'w')",
}


TRAPPED = """
import os, sys
sys.path.insert(0, {place!r})
import trace_worker, subprocess, socket, pickle
deeds = [{deeds}]
for folder, deed in zip(sys.argv[1:], deeds, strict=True):
    # A process each, forked from one that has loaded the readers: what a deed leaves ends with it.
    child = os.fork()
    if not child:
        sys.argv = ["worker", folder]
        trace_worker.LIBRARIES += (f"/proc/{{os.getpid()}}",)
        trace_worker.read = deed
        trace_worker.main()
        sys.stdout.flush()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, folder
"""


@pytest.fixture(scope="module")
def trapped(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, object]]:
    """What the trace saw of each of `TRAPS`."""
    place = tmp_path_factory.mktemp("traps")
    folders, deeds = [], []
    for number, deed in enumerate(TRAPS.values()):
        folders.append(place / str(number))
        folders[-1].mkdir()
        (folders[-1] / "log.csv").write_text("time,BmUp\n0,1\n0.01,2\n0.02,3\n")
        deeds.append(f"lambda path: str({deed(str(place / f'marker{number}'))})")
    script = TRAPPED.format(place=str(WORKER.parent), deeds=", ".join(deeds))
    command = [sys.executable, "-c", script, *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=place)
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(zip(TRAPS, map(json.loads, done.stdout.splitlines()), strict=True))


@pytest.mark.parametrize("trap", TRAPS)
def test_the_trace_sees_what_it_is_for(trap, trapped):
    """A reader that does such a thing is found."""
    assert trapped[trap]["events"]["log.csv"]
