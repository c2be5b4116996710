"""FMUs built from their sources, and instances of them that are the same for both versions of FMI."""

from __future__ import annotations

import ctypes
import re
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edp.export.fmu.target import FmuTarget
from edp.export.golden import random_inputs, stream, tolerance

try:
    import fmpy
    from fmpy import fmi2, fmi3
except ImportError:  # the tests that need it say so and are skipped
    fmpy = None

FOLDERS = {2: "linux64", 3: "x86_64-linux"}
BUILD = ("-std=c99", "-O1", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared")


@dataclass(eq=False)
class Unit:
    """An instance of an unpacked FMU, the same for both versions."""

    folder: Path
    version: int
    token: str = ""
    told: list[tuple[int, str]] = field(default_factory=list)

    def __post_init__(self):
        self.about = fmpy.read_model_description(str(self.folder))
        listed = self.about.modelVariables
        self.inputs = [v.valueReference for v in listed if v.causality == "input"]
        self.outputs = [v.valueReference for v in listed if v.causality == "output" and v.type in ("Real", "Float64")]
        self.refs = {v.name: v.valueReference for v in listed}
        self.step_s = float(self.about.defaultExperiment.stepSize)
        kind = fmi2.FMU2Slave if self.version == 2 else fmi3.FMU3Slave
        about = self.about
        guid = self.token or (about.guid if self.version == 2 else about.instantiationToken)
        names = {"modelIdentifier": about.coSimulation.modelIdentifier, "instanceName": "one"}
        self.fmu = kind(guid=guid, unzipDirectory=str(self.folder), **names)
        if self.version == 2:
            self.callbacks = fmi2.fmi2CallbackFunctions()
            self.callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda e, n, s, c, m: self.told.append((s, m.decode())))
            self.fmu.instantiate(callbacks=self.callbacks)
        else:
            self.fmu.instantiate(logMessage=lambda e, s, c, m: self.told.append((s, m.decode())))
        self.tick = 0

    def start(self, at=0.0):
        if self.version == 2:
            self.fmu.setupExperiment(startTime=at)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=at)
        self.fmu.exitInitializationMode()
        self.tick = round(at / self.step_s)
        return self

    def set(self, row, refs=None):
        put = self.fmu.setReal if self.version == 2 else self.fmu.setFloat64
        put(self.inputs if refs is None else refs, [float(v) for v in row])

    def get(self, refs):
        return np.array((self.fmu.getReal if self.version == 2 else self.fmu.getFloat64)(refs))

    def whole(self, name):
        return (self.fmu.getInteger if self.version == 2 else self.fmu.getInt32)([self.refs[name]])[0]

    @property
    def valid(self):
        return bool(self.fmu.getBoolean([self.refs["valid"]])[0])

    def go(self, at=None, size=None):
        """A step; its status, 0 or 1."""
        at, size = self.tick * self.step_s if at is None else at, size or self.step_s
        if self.version == 2:
            status = self.fmu.fmi2DoStep(self.fmu.component, at, size, 1)
        else:
            flags = [ctypes.byref(fmi3.fmi3Boolean()) for _ in range(3)]
            last = ctypes.byref(fmi3.fmi3Float64())
            status = self.fmu.fmi3DoStep(self.fmu.component, at, size, True, *flags, last)
        self.tick += 1
        return status

    def stream(self, rows):
        found = []
        for row in rows:
            self.set(row)
            self.go()
            found.append(self.get(self.outputs))
        return np.array(found, dtype=np.float32)


@pytest.fixture(scope="session")
def written(bundle_of, tmp_path_factory):
    """The FMU of an exported network, sources only."""
    made: dict[tuple[str, bool], Path] = {}

    def write(structure: str, version: int, whole: bool = False) -> Path:
        key = (structure, whole)
        if key not in made:
            made[key] = tmp_path_factory.mktemp("fmu")
            FmuTarget(binaries="none").write(bundle_of(structure, whole), "predictor", made[key])
        return made[key] / f"predictor_fmi{version}.fmu"

    return write


@pytest.fixture(scope="session")
def unpacked(c, written, tmp_path_factory):
    """A folder with the content of an FMU and a library built from its sources alone, as its XML lists them."""
    made: dict[tuple[str, int, bool], Path] = {}

    def build(structure: str, version: int, whole: bool = False) -> Path:
        c.need("gcc")
        key = (structure, version, whole)
        if key not in made:
            folder = made[key] = tmp_path_factory.mktemp("unpacked")
            with zipfile.ZipFile(written(structure, version, whole)) as archive:
                archive.extractall(folder)
            target = folder / "binaries" / FOLDERS[version]
            target.mkdir(parents=True)
            listed = sources_of(folder, version)
            c.run("gcc", *BUILD, *listed, "-lm", "-o", target / "predictor.so", folder=folder / "sources")
        return made[key]

    return build


@pytest.fixture(scope="session")
def unit(unpacked):
    """Makes instances."""

    def make(structure: str, version: int, whole: bool = False) -> Unit:
        return Unit(unpacked(structure, version, whole), version)

    return make


def sources_of(folder, version):
    """C files that the FMU says must be compiled."""
    if version == 2:
        return [e.get("name") for e in ET.parse(folder / "modelDescription.xml").iter("File")]
    return [e.get("name") for e in ET.parse(folder / "sources/buildDescription.xml").iter("SourceFile")]


def standard():
    """The folder of the standard's headers."""
    return Path(fmpy.__file__).parent / "c-code"


def functions_of(version):
    """Functions that the standard's header exports; those of model exchange in 2.0 are not for co-simulation."""
    text = (standard() / f"fmi{version}Functions.h").read_text()
    found = set(re.findall(rf"^\s*FMI{version}_Export\s+\w+\s+(fmi{version}\w+);", text, re.M))
    exchange = "EnterEventMode NewDiscreteStates EnterContinuousTimeMode CompletedIntegratorStep SetTime"
    states = "SetContinuousStates GetDerivatives GetEventIndicators GetContinuousStates GetNominalsOfContinuousStates"
    return found - ({f"fmi2{name}" for name in f"{exchange} {states}".split()} if version == 2 else set())


def exported(library):
    lines = subprocess.run(["nm", "-D", "--defined-only", library], capture_output=True, text=True, check=True)
    return {line.split()[-1] for line in lines.stdout.splitlines()}


def held_to_pytorch(made, bundle, ticks):
    predictor = bundle.predictor
    inputs = random_inputs(predictor, ticks, seed=5)
    wanted = stream(predictor, inputs)
    found = made.start().stream(inputs)
    assert found.shape == wanted.shape
    assert (np.abs(found - wanted) <= tolerance(predictor, inputs, wanted)).all()
    assert made.whole("status") == 0
    assert made.valid
    assert not made.told


@pytest.fixture(scope="session")
def fmi() -> SimpleNamespace:
    """What tests need to know of FMUs and the standard."""
    return SimpleNamespace(
        Unit=Unit,
        folders=FOLDERS,
        sources=sources_of,
        standard=standard,
        functions=functions_of,
        exported=exported,
        held=held_to_pytorch,
    )
