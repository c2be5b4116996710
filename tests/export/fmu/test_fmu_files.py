"""What is in an FMU: description, sources, libraries."""

from __future__ import annotations

import re
import shutil
import zipfile
from pathlib import Path

import compiled
import numpy as np
import pytest

from edp.errors import ExportError
from edp.export import make_target
from edp.export.fmu.target import FmuTarget
from edp.export.fmu.units import BASES, shown
from edp.export.golden import random_inputs, tolerance
from edp.signals import KINDS, Kind

fmpy = pytest.importorskip("fmpy", reason="needs FMPy: pip install 'excavator-dynamics-predictor[fmu]'")
from fmpy.fmi1 import FMICallException  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

MINGW = "x86_64-w64-mingw32-gcc"
both = pytest.mark.parametrize("version", [2, 3])


@both
@pytest.mark.parametrize("network", ["hybrid+all", "tcn+quantiles"])
def test_the_description_is_sound(network, version, written, bundle_of):
    file, bundle = written(network, version), bundle_of(network)
    assert validate_fmu(str(file)) == []
    about = fmpy.read_model_description(str(file))
    assert [v.name for v in about.modelVariables if v.causality == "input"] == [c.name for c in bundle.inputs]
    assert about.coSimulation.canHandleVariableCommunicationStepSize is False
    assert about.defaultExperiment.stepSize == str(1.0 / bundle.task.rate_hz)
    for name in (v.name for v in about.modelVariables if "lower" in v.name):
        assert name.replace("lower", "upper") in {v.name for v in about.modelVariables}
    with zipfile.ZipFile(file) as archive:
        assert {"documentation/index.html", "resources/predictor.json"} <= set(archive.namelist())


def promised(text):
    """What a description says of derivatives, in the word of its version."""
    return re.findall(r'providesDirectionalDerivatives?="(\w+)"', text)[0]


@both
@pytest.mark.parametrize("whole", [False, True])
def test_derivatives_are_not_promised_where_there_are_none(whole, version, bundle_of, unit, tmp_path):
    bundle = bundle_of("hybrid", whole)
    file = FmuTarget(str(version), "none", derivatives=whole).write(bundle, "predictor", tmp_path)[0]
    assert validate_fmu(str(file)) == []
    with zipfile.ZipFile(file) as archive:
        assert promised(archive.read("modelDescription.xml").decode()) == "false"
    if whole:
        made = unit("hybrid", version, whole=True).start()
        made.stream(random_inputs(bundle.predictor, 2, 0))
        with pytest.raises(FMICallException):
            made.fmu.getDirectionalDerivative(made.outputs, made.inputs[:1], [1.0])
        assert "provides no derivatives" in made.told[-1][1]


@both
def test_the_library_exports_the_functions_of_the_standard_and_no_other(c, version, unpacked, fmi):
    assert shutil.which("nm")
    folder = unpacked("hybrid+all", version)
    assert fmi.exported(folder / "binaries" / fmi.folders[version] / "predictor.so") == fmi.functions(version)


@both
def test_its_sources_are_clean_and_agree_with_the_standards_headers(c, version, unpacked, tmp_path, fmi):
    sources = unpacked("lstm", version) / "sources"
    listed = [sources / name for name in fmi.sources(sources.parent, version)]
    c.run("gcc", *c.flags, "-c", *listed, folder=tmp_path)
    plumbing = [file for file in listed if file.name.startswith("edp_fm")]
    standard = ("-DEDP_FMI_HEADERS", f"-isystem{fmi.standard()}", "-Wmissing-prototypes")
    c.run("gcc", *c.flags, *standard, "-c", *plumbing, folder=tmp_path)
    c.run("gcc", *c.flags, f"-DFMI{version}_FUNCTION_PREFIX=predictor_", "-c", *plumbing, folder=tmp_path)
    names = {
        line.split()[-1] for line in c.run("nm", *tmp_path.glob("edp_fmi*.o")).decode().splitlines() if " T " in line
    }
    assert names == {f"predictor_{name}" for name in fmi.functions(version)}


@pytest.mark.slow
def test_fmpy_rebuilds_it(c, unpacked, bundle_of, tmp_path, fmi):
    c.need("cmake", "gcc")
    from fmpy.build import build_platform_binary

    folder = tmp_path / "copy"
    shutil.copytree(unpacked("lstm", 3), folder)
    shutil.rmtree(folder / "binaries")
    (tmp_path / "build").mkdir()
    build_platform_binary(folder, tmp_path / "build", cmake_options={"CMAKE_C_FLAGS:STRING": "-ffp-contract=off"})
    fmi.held(fmi.Unit(folder, 3), bundle_of("lstm"), 50)


def zig():
    return pytest.importorskip("ziglang", reason="needs ziglang: pip install 'excavator-dynamics-predictor[fmu]'")


def test_its_library_runs_on_old_linux(c, bundle_of, tmp_path, fmi):
    zig()
    made = FmuTarget(binaries="linux64").write(bundle_of("lstm"), "predictor", tmp_path)
    assert [file.name for file in made] == ["predictor_fmi2.fmu", "predictor_fmi3.fmu"]
    for version, file in zip((2, 3), made):
        folder = tmp_path / str(version)
        with zipfile.ZipFile(file) as archive:
            archive.extractall(folder)
        library = folder / "binaries" / fmi.folders[version] / "predictor.so"
        assert fmi.exported(library) == fmi.functions(version)
        needed = re.findall(r"GLIBC_(\d+)\.(\d+)", c.run("objdump", "-T", library).decode())
        assert needed
        assert max((int(a), int(b)) for a, b in needed) <= (2, 17)
        fmi.held(fmi.Unit(folder, version), bundle_of("lstm"), 50)
    first = [file.read_bytes() for file in made]
    with compiled.fresh():
        FmuTarget(binaries="linux64").write(bundle_of("lstm"), "predictor", tmp_path)
    assert [file.read_bytes() for file in made] == first  # the same network gives the same bytes


@pytest.mark.slow
def test_its_windows_library_runs_under_wine(c, unit, bundle_of, tmp_path):
    zig()
    if not (shutil.which("wine") and shutil.which(MINGW)):
        pytest.skip("needs the Debian packages wine wine64 gcc-mingw-w64-x86-64 (make system-packages)")
    for network, exact in (("lstm", True), ("hybrid+all", False)):  # GELU is the C library's, which rounds otherwise
        folder, bundle = tmp_path / network, bundle_of(network)
        file = FmuTarget("2", "win64").write(bundle, "predictor", folder)[0]
        with zipfile.ZipFile(file) as archive:
            archive.extractall(folder)
        host = Path(__file__).parent / "host.c"
        c.run(MINGW, "-std=c99", "-static", "-I", folder / "sources", host, "-o", "host.exe", folder=folder)
        made, rows = unit(network, 2), random_inputs(bundle.predictor, 100, 3)
        (folder / "rows").write_bytes(rows.astype(float).tobytes())
        sizes = (len(made.inputs), len(made.outputs))
        given = ("binaries/win64/predictor.dll", made.about.guid, *sizes, made.step_s, "rows", "found")
        c.run("env", "WINEDEBUG=-all", f"WINEPREFIX={tmp_path}/wine", "wine", "host.exe", *given, folder=folder)
        found = np.frombuffer((folder / "found").read_bytes()).reshape(len(rows), -1).astype(np.float32)
        wanted = made.start().stream(rows)
        allowed = 0.0 if exact else tolerance(bundle.predictor, rows, wanted)
        assert (np.abs(found - wanted) <= allowed).all()


def test_what_is_not_written_is_refused(bundle_of, tmp_path, monkeypatch):
    with pytest.raises(ExportError, match="choose one of 2, 3, both"):
        make_target("fmu", {"version": "1"})
    with pytest.raises(ExportError, match="choose one of both, linux64, win64, none"):
        make_target("fmu", {"binaries": "mac"})
    with pytest.raises(ExportError, match="--name"):
        FmuTarget().write(bundle_of("lstm"), "for", tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ExportError, match="--set binaries=none"):
        FmuTarget().write(bundle_of("lstm"), "predictor", tmp_path)
    assert not list(tmp_path.iterdir())


def test_every_kind_of_channel_has_its_unit():
    for kind in Kind:
        assert KINDS[kind].si_unit in BASES
        also = shown(kind)
        assert also is None or also.name == KINDS[kind].report_unit
    assert shown(Kind.PRESSURE).factor * 2e5 == pytest.approx(2.0)  # bar
    degrees = shown(Kind.TEMPERATURE)
    assert degrees.factor * 300.0 + degrees.offset == pytest.approx(26.85)
