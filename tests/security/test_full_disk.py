"""Writers of libraries on a full disk: one message of EDP's own, and no file is left half written."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from edp.errors import StorageError
from edp.export import TARGETS
from edp.logs import FORMATS, LogFormat
from edp.storage import replacing, replacing_folder
from edp.storage.writing import system_failure

CHILD = """
import json, resource, signal, sys
from pathlib import Path
import numpy as np
from edp.errors import StorageError
from edp.logs import write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1

values = np.random.default_rng(0).standard_normal((50_000, 2)).astype(np.float32)
channels = (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"])
recording = Recording("a", rate_hz=100.0, channels=channels, values=values)
folder, said = Path(sys.argv[1]), {}
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for suffix in sys.argv[2:]:
    try:
        write_recording(recording, folder / f"log{suffix}")
        said[suffix] = "written"
    except StorageError as error:
        said[suffix] = str(error)
    except BaseException as error:
        said[suffix] = f"{type(error).__name__}: {error}"
print(json.dumps(said))
"""


@pytest.mark.processes
def test_every_format_of_logs_tells_of_a_full_disk_and_leaves_nothing(tmp_path):
    suffixes = sorted(
        {suffix for form in FORMATS.values() if type(form).write is not LogFormat.write for suffix in form.suffixes}
    )
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path), *suffixes], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    said = json.loads(done.stdout.splitlines()[-1])
    assert len(said) >= 4
    for suffix, text in said.items():
        assert text.startswith(f"cannot write '{tmp_path}"), f"{suffix}: {text}"
        assert "free space" in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.processes
def test_every_command_that_writes_names_the_file_and_leaves_no_part(tmp_path):
    worker = Path(__file__).with_name("full_disk_commands.py")
    surroundings = os.environ | {"COLUMNS": "2000", "TERM": "dumb"}
    done = subprocess.run(
        [sys.executable, str(worker), str(tmp_path)], capture_output=True, text=True, check=False, env=surroundings
    )
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert len(told) >= 2 * len(TARGETS) + 7
    for one in told:
        command, said = one["command"], one["said"]
        assert one["code"] not in (0, None), f"{command}: {said}"
        assert "Traceback" not in said, f"{command}: {said}"
        assert said.count("error: ") == 1, f"{command}: {said}"
        named = re.search(r"error: cannot write '([^']+)': File too large; free space", said)
        assert named, f"{command}: {said}"
        assert not Path(named[1]).exists(), f"{command}: {named[1]} is half written"
        assert [file for file in one["left"] if file.endswith(".tmp")] == [], command
        assert [file for file in one["left"] if Path(file).name not in MAY_STAY] == [], command


@pytest.mark.parametrize("writer", [replacing, replacing_folder])
@pytest.mark.parametrize(
    "raised",
    [
        RuntimeError("Unable to flush file (file write failed: time = x, errno = 28, error message = 'No space left')"),
        ValueError("Error writing: No space left on device"),
    ],
)
def test_an_error_of_a_library_that_stems_from_the_system_is_told(writer, raised, tmp_path):
    with pytest.raises(StorageError, match=r"cannot write .*; free space"), writer(tmp_path / "made"):
        raise raised
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_the_program_stays(tmp_path):
    with pytest.raises(ZeroDivisionError), replacing(tmp_path / "made"):
        raise ZeroDivisionError
    assert system_failure(KeyError("a")) is None
    assert list(tmp_path.iterdir()) == []


MAY_STAY = (".lock", "export.unfinished")
"""Files that say that a folder holds nothing whole yet."""
SOURCE = Path(__file__).parents[2] / "src" / "edp"
WRITERS = {"write_table", "to_parquet", "savemat", "savefig", "imsave", "save_file", "write_image", "to_csv", "savez"}
IN_MEMORY = {
    "export/description.py": "into a buffer",
    "export/casadi/target.py": "into a buffer",
    "logs/formats/parquet.py": "of `write_recording`, within replacing",
    "sim/physics/snapshot.py": "within replacing",
    "workflows/parity/forms/matlab.py": "into a temporary folder of its own, which is removed",
}
"""Files that call writers of libraries: where the bytes go."""
METHODS = {"write_text", "write_bytes"}
"""Of paths: their errors name no file, where the disk is full."""
BESIDE = {
    "storage/writing.py": "within replacing",
    "storage/archives.py": "unpacks",
    "cli/doctor.py": "looks at what it wrote",
    "testing/logs.py": "for tests",
}
"""Files that call `METHODS`, and why."""


def named(call):
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def test_writers_of_libraries_write_through_the_storage():
    """A new call goes into a buffer that `write_bytes` writes, or stands within `replacing`; then it is listed here."""
    found = set()
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and named(node) in WRITERS:
                found.add(str(path.relative_to(SOURCE)).replace(os.sep, "/"))
    assert found <= set(IN_MEMORY), found - set(IN_MEMORY)
    assert set(IN_MEMORY) <= found, set(IN_MEMORY) - found


def test_files_are_written_by_the_storage():
    found = set()
    for path in SOURCE.rglob("*.py"):
        calls = [
            node.func for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)
        ]
        if any(isinstance(call, ast.Attribute) and call.attr in METHODS for call in calls):
            found.add(path.relative_to(SOURCE).as_posix())
    assert sorted(found ^ BESIDE.keys()) == [], "call edp.storage.write_bytes, or say here why not"
