"""The FMUs of both versions of FMI through FMPy: values set, a step, values read, at every tick."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from edp.control.fmu.archive import FmuArchive
from edp.export.fmu import FmuTarget
from edp.export.golden import Rows
from edp.workflows.parity.base import FORMS, NAME, Broken, Missing, ParityCase, Ran, timed


class Slave:
    """An instance of an FMU for co-simulation, the same for both versions; FMPy and its arrays are prepared once."""

    def __init__(self, file: Path, folder: Path, version: int) -> None:
        """Unpack `file` into `folder` and load its library.

        Raises:
            Broken: FMPy does not load or instantiate it.
        """
        import fmpy
        from fmpy import fmi2, fmi3

        FmuArchive(file).unpack_all(folder)
        about = fmpy.read_model_description(str(folder))
        listed = about.modelVariables
        real = "Real" if version == 2 else "Float64"
        self.inputs = [v.valueReference for v in listed if v.causality == "input"]
        self.outputs = [v.valueReference for v in listed if v.causality == "output" and v.type == real]
        self.step_s = float(about.defaultExperiment.stepSize)
        self.version = version
        slave: Any = (fmi2.FMU2Slave if version == 2 else fmi3.FMU3Slave)(
            guid=about.guid if version == 2 else about.instantiationToken,
            unzipDirectory=str(folder),
            modelIdentifier=about.coSimulation.modelIdentifier,
            instanceName=NAME,
        )
        slave.instantiate()
        self.fmu = slave
        self.put, self.take = (slave.setReal, slave.getReal) if version == 2 else (slave.setFloat64, slave.getFloat64)

    def stream(self, inputs: Rows) -> Rows:
        """Return the predictions after each row ``(tick, number)``, from a reset."""
        fmu, put, take, step_s, predictions = self.fmu, self.put, self.take, self.step_s, []
        fmu.reset()
        if self.version == 2:
            fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        for tick, row in enumerate(inputs.tolist()):
            put(self.inputs, row)
            fmu.doStep(tick * step_s, step_s)
            predictions.append(take(self.outputs))
        return np.array(predictions, dtype=np.float32)

    def close(self) -> None:
        """Unload the instance and its library."""
        self.fmu.freeInstance()


@FORMS.register("fmu")
class Fmu:
    """``edp export --format fmu``, its library for Linux."""

    title: ClassVar[str] = "FMU in FMPy"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        for package in ("fmpy", "ziglang"):
            if importlib.util.find_spec(package) is None:
                raise Missing(f"needs the package {package}: pip install 'excavator-dynamics-predictor[fmu]'")
        runs = []
        for version, file in zip((2, 3), FmuTarget(binaries="linux64").write(case.bundle, NAME, folder), strict=True):
            try:
                slave = Slave(file, folder / str(version), version)
                predictions, seconds = timed(lambda slave=slave: slave.stream(case.inputs))  # type: ignore[misc]
                slave.close()
            except Exception as error:  # FMPy raises plain exceptions
                raise Broken(f"FMPy on {file.name}: {error}") from error
            runs.append((f"FMI {version}.0", Ran(predictions, seconds / len(predictions))))
        return runs
