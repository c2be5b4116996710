"""Native code in a reader reaches no other process, file or socket; where a layer is missing, somebody is told."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.logs import open_log, read_recording, write_recording
from edp.recording import Recording
from edp.sandbox import end, layers
from edp.sandbox.environment import BUILD_NAMES, reduce_environment
from edp.signals import TABLE_A1, SignalMap
from edp.workflows.parity.base import called

LINUX = sys.platform.startswith("linux") and platform.machine() in ("x86_64", "aarch64")
pytestmark = pytest.mark.skipif(not LINUX, reason="the kernel's layers are Linux's")
HERE = Path(__file__).parent
SECRET = "AWS_SECRET_ACCESS_KEY"
ALL = ("files", "process", "sockets", "kernel")
LACKING = ("file rules", "system-call filter", "limits")
"""Layers that a test can take away from the kernel; the audit hook is Python's."""


def without(layer, *command, **environment):
    """Run a command of this interpreter as on a kernel that lacks a layer."""
    places = os.pathsep.join([str(HERE), *filter(None, sys.path)])
    line = [sys.executable, HERE / "without_layer.py", layer, sys.executable, *command]
    given = os.environ | {"PYTHONPATH": places, "COLUMNS": "400"} | environment
    return subprocess.run([str(part) for part in line], env=given, capture_output=True, text=True)


def probed(layer, folder, groups=ALL, **environment):
    done = without(layer, HERE / "probing_parent.py", folder, *groups, **environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def assert_untouched(found):
    assert (found["files"], found["process"], found["connected"]) == ([], [], 0)


def test_native_code_reaches_nothing_with_all_layers(tmp_path):
    found = probed("", tmp_path)
    assert found["layers"] == {layer.name: "" for layer in layers.LAYERS}
    assert found["tried"] > 500
    assert found["reached"] == {}
    assert_untouched(found)
    assert found["warned"] == []


def test_without_limits_native_code_reaches_nothing(tmp_path):
    found = probed("limits", tmp_path)
    assert found["reached"] == {}
    assert_untouched(found)
    assert_told(found, "limits")


def assert_told(found, layer):
    assert [name for name, missing in found["layers"].items() if missing] == [layer]
    (said,) = found["warned"]
    assert f"the layer '{layer}' of the sandbox is missing" in said
    assert "EDP_SANDBOX=require" in said


def test_without_landlock_another_process_opens_files_and_native_code_reaches_nothing(tmp_path):
    found = probed("Landlock", tmp_path)
    assert found["layers"] == {layer.name: "" for layer in layers.LAYERS}
    assert found["tried"] > 500
    assert found["reached"] == {}
    assert_untouched(found)
    assert found["warned"] == []


def test_without_file_rules_native_code_can_read_and_nothing_else(tmp_path):
    found = probed("file rules", tmp_path)
    reading = ("open outside", "open by a handle", "folder ", "passwd", "/proc")
    assert [probe for probe in found["reached"] if not probe.startswith(reading)] == []
    assert_untouched(found)
    assert_told(found, "file rules")


def test_without_the_filter_landlock_still_holds_files_and_somebody_is_told(tmp_path):
    # Not the group `kernel`: what succeeds in it would outlive the test.
    found = probed("system-call filter", tmp_path, ("files", "process", "sockets"))
    opened = ("open", "folder", "passwd", "/proc", "creat", "truncate", "unlink", "mkdir", "mknod", "rename", "ptrace")
    past = [probe for probe in found["reached"] if probe.startswith(opened) and not probe.startswith("open_tree")]
    assert [probe for probe in past if not probe.endswith(" log")] == []
    assert not {"process_vm_readv", "process_vm_writev", "TCP"} & set(found["reached"])
    assert_told(found, "system-call filter")


@pytest.mark.parametrize("layer", LACKING)
def test_where_a_layer_is_missing_logs_are_refused_if_all_are_required(layer, tmp_path):
    found = probed(layer, tmp_path, EDP_SANDBOX="require")
    assert found["tried"] == 0
    assert found["reached"] == {}
    needs = next(each for each in layers.LAYERS if each.name == layer)
    for said in (
        f"'{tmp_path / 'x.hostile'}' is not read",
        f"'{layer}'",
        needs.needs,
        needs.advice,
        "without EDP_SANDBOX",
    ):
        assert said in found["refused"]
    assert found["warned"] == []
    assert_untouched(found)


@pytest.mark.parametrize("layer", ["", *LACKING])
def test_commands_say_once_which_layer_is_missing(layer, tmp_path):
    for name in ("a", "b", "c"):
        write_recording(recording(), tmp_path / f"{name}.csv")
    # As a document for programs where a layer is missing, which the warning must not get into.
    done = without(layer, "-m", "edp", "data", "check", tmp_path, *(["--json"] if layer else []))
    assert done.stderr.count("warning: logs are read with less protection") == bool(layer)
    if layer:
        assert f"'{layer}'" in done.stderr
        json.loads(done.stdout)


def test_a_missing_layer_can_be_accepted_and_can_be_a_reason_to_end(tmp_path):
    path = write_recording(recording(), tmp_path / "a.csv")
    silent = without("file rules", "-m", "edp", "data", "check", path, EDP_SANDBOX="accept")
    assert "protection" not in silent.stderr
    refused = without("file rules", "-m", "edp", "data", "check", path, EDP_SANDBOX="require")
    assert "is not read: the layer 'file rules'" in " ".join((refused.stderr + refused.stdout).split())
    assert "Traceback" not in refused.stderr
    assert refused.returncode != 0


@pytest.mark.parametrize(("layer", "wish"), [*((layer, "") for layer in ("", *LACKING)), ("file rules", "require")])
def test_doctor_shows_every_layer(layer, wish, tmp_path):
    done = without(layer, "-m", "edp", "doctor", tmp_path, "--json", EDP_SANDBOX=wish)
    checks = {check["what"]: check for check in json.loads(done.stdout)["checks"]}
    for each in layers.LAYERS:
        check = checks[f"sandbox: {each.name}"]
        assert check["state"] == ("missing" if each.name == layer else "ok")
        assert each.stops in check["needed_for"]
        assert (each.advice in check["needed_for"]) == (each.name == layer)
    assert (checks["reading of logs"]["state"] == "broken") == bool(layer and wish)


def recording(samples=20):
    channels = (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"])
    return Recording("R1", channels, np.ones((samples, 2), dtype=np.float32), 100.0)


@pytest.fixture
def look(tmp_path, hostile_worker, monkeypatch):
    """What a reader finds in its own process."""
    from edp.logs import FORMATS

    monkeypatch.setitem(FORMATS._parts, "hostile", hostile_worker)
    monkeypatch.setenv(SECRET, "key of the user")
    monkeypatch.setenv("GITHUB_TOKEN", "token of the user")
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    end()
    (log := tmp_path / "x.hostile").write_text("look||open")
    yield dict(open_log(log, SignalMap()).meta)
    end()


def test_a_reader_sees_only_listed_variables(look):
    assert look["environment"]["LC_ALL"] == "C.UTF-8"
    for seen in (str(look["environment"]), look["proc"]):
        assert "of the user" not in seen
        assert SECRET not in seen
    own = {"PYTHONPATH", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"}
    assert set(look["environment"]) <= set(reduce_environment()) | own | {"MIMALLOC_ARENA_RESERVE"}


def test_a_reader_holds_two_pipes_and_nothing_else(look):
    kinds = sorted(target.partition(":")[0] for target in look["handles"].values())
    assert kinds == ["/dev/null"] * 3 + ["pipe"] * 2


def test_exported_code_that_is_run_sees_only_listed_variables(tmp_path, monkeypatch):
    monkeypatch.setenv(SECRET, "key of the user")
    monkeypatch.setenv("CC", "gcc")
    said = called([sys.executable, "-c", "import os; print(dict(os.environ))"], tmp_path).decode()
    assert "of the user" not in said
    assert "'CC': 'gcc'" in said
    assert "CC" not in reduce_environment()
    assert "CC" in BUILD_NAMES


def test_a_reader_that_says_nothing_of_its_layers_is_not_believed(tmp_path):
    for stated in (None, {}, [], {"file rules": ""}, {layer.name: "" for layer in layers.LAYERS[1:]}):
        with pytest.raises(DataError, match="does not state the layers"):
            layers.note_layers(tmp_path, stated)


def test_a_word_that_the_setting_does_not_know_is_refused_before_anything_is_read(tmp_path, monkeypatch):
    path = write_recording(recording(), tmp_path / "a.csv")
    monkeypatch.setenv(layers.VARIABLE, "yes")
    with pytest.raises(ConfigError, match="EDP_SANDBOX: got 'yes', expected 'require' or 'accept'"):
        read_recording(path)


def test_python_can_require_the_layers(monkeypatch, tmp_path):
    monkeypatch.setattr(layers, "_state", layers._State())
    monkeypatch.delenv(layers.VARIABLE, raising=False)
    stated = {layer.name: "" for layer in layers.LAYERS} | {"file rules": "no such call"}
    with pytest.warns(layers.SandboxWarning, match="'file rules'"):
        layers.note_layers(tmp_path, stated)
    layers.require_layers()
    with pytest.raises(DataError, match=r"require_layers\(\) asks for all layers"):
        layers.note_layers(tmp_path, stated)
    layers.require_layers(False)
    layers.note_layers(tmp_path, stated)  # announced already


WITHOUT_LANDLOCK = """
import os, sys, time
from pathlib import Path
import hostile_format
from edp.errors import EdpError
from edp.logs import read_recording
from edp.sandbox import end

folder = Path(sys.argv[1])
for path in sorted(folder.glob("log.*")):
    print("read", path.suffix, read_recording(path).samples)
for each in ("crash|11", "crash|6", "exit|3", "exit|0", "fail|x", "loop|", "layers|"):
    log = folder / "x.hostile"
    log.write_text(f"{each}|open")
    try:
        read_recording(log)
    except EdpError as error:
        print("said", each, error)
end()
for _ in range(3000):
    left = []
    for name in os.listdir("/proc"):
        try:
            own = Path("/proc", name, "environ").read_bytes() if name.isdigit() and int(name) != os.getpid() else b""
        except OSError:
            continue
        if f"EDP_TEST_MARK={folder}".encode() in own:
            left.append(name)
    if not left:
        break
    time.sleep(0.01)
print("left", left)
"""


def test_without_landlock_every_format_is_read_and_every_end_of_a_reader_is_told(tmp_path):
    from edp.logs import FORMATS

    suffixes = sorted(part.suffixes[0] for name, part in FORMATS.items() if name != "hostile")
    for suffix in suffixes:
        write_recording(recording(), tmp_path / f"log{suffix}")
    done = without("Landlock", "-c", WITHOUT_LANDLOCK, tmp_path, EDP_TEST_START_S="0.2", EDP_TEST_MARK=str(tmp_path))
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("read")] == [f"read {suffix} 20" for suffix in suffixes]
    said = "\n".join(lines)
    for text in ("signal 11", "signal 6", "exit code 3", "exit code 0", "KeyError", "more processor time"):
        assert text in said
    assert "file rules and system-call filter and limits and audit hook" in said
    assert lines[-1] == "left []"
    assert done.stderr == ""
