"""One running instance of an FMU for co-simulation: native code in this process, behind FMPy."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edp.control.fmu.archive import FmuArchive
from edp.control.fmu.description import FmuDescription
from edp.errors import ConfigError, DataError
from edp.sim.scenario import SimulationError
from edp.storage.archives import printable

NAME = "plant"


class FmuInstance:
    """An instance that starts over at each `begin`.

    Args:
        archive: checked.
        description: description of the FMU.

    Raises:
        ConfigError: FMPy is not installed.
        DataError: there is no library for this computer, or it cannot be loaded or instantiated.
    """

    def __init__(self, archive: FmuArchive, description: FmuDescription) -> None:
        try:
            import fmpy
            from fmpy import fmi2, fmi3
        except ImportError as error:
            raise ConfigError(
                "FMUs as plants need the package FMPy, which is not installed; run pip install "
                "'excavator-dynamics-predictor[control,fmu]'"
            ) from error
        self._where, self._version = f"FMU '{archive.path}'", description.version
        self._message = ""
        platform = fmpy.platform if description.version == 2 else fmpy.platform_tuple
        library = f"binaries/{platform}/{description.identifier}{fmpy.sharedLibraryExtension}"
        binaries = archive.under("binaries")
        if library not in binaries:
            others = sorted({name.split("/")[1] for name in binaries})
            listed = f"libraries for {', '.join(map(printable, others[:5]))}" if others else "no library at all"
            raise DataError(
                f"{self._where} has no library for this computer ({platform}) but {listed}; export it for this system"
            )
        folder = Path(tempfile.mkdtemp(prefix="edp-fmu-"))
        # Not a TemporaryDirectory: nobody closes an environment for sure, and that one would warn.
        self._ending = weakref.finalize(self, shutil.rmtree, folder, True)
        archive.unpack(folder, (f"binaries/{platform}", "resources"))
        kind = fmi2.FMU2Slave if description.version == 2 else fmi3.FMU3Slave
        self._fmu: Any = None
        self._call_guarded("be loaded", lambda: self._load(kind, description, folder))
        self._call_guarded("be instantiated", lambda: self._instantiate(fmi2))
        self._fresh = True

    def begin(self, references: Sequence[int] = (), values: Sequence[float] = ()) -> None:
        """Start at time 0, with values that are set before the initialisation.

        Raises:
            SimulationError: it refuses.
        """
        if not self._fresh:
            self._call("reset", self._fmu.reset)
        self._fresh = False
        if self._version == 2:
            self._call("setupExperiment", lambda: self._fmu.setupExperiment(startTime=0.0))
        if references:
            self.put(references, values)
        self._call("enterInitializationMode", self._fmu.enterInitializationMode)
        self._call("exitInitializationMode", self._fmu.exitInitializationMode)

    def put(self, references: Sequence[int], values: Sequence[float]) -> None:
        """Set real variables.

        Raises:
            SimulationError: it refuses.
        """
        put = self._fmu.setReal if self._version == 2 else self._fmu.setFloat64
        self._call("set", lambda: put(references, values))

    def read(self, references: Sequence[int]) -> list[float]:
        """Return the values of real variables.

        Raises:
            SimulationError: it refuses.
        """
        take = self._fmu.getReal if self._version == 2 else self._fmu.getFloat64
        values: list[float] = self._call("get", lambda: take(references))
        return values

    def step(self, at_s: float, size_s: float) -> None:
        """Advance by one step from a given time.

        Raises:
            SimulationError: it refuses.
        """
        self._call("doStep", lambda: self._fmu.doStep(at_s, size_s))

    def close(self) -> None:
        """Unload the instance and remove its files; repeated calls are allowed."""
        if self._ending.alive:
            self._fmu.freeInstance()
            self._ending()

    def _load(self, kind: Any, description: FmuDescription, folder: Path) -> None:
        # FMPy changes the working folder while it loads, and leaves it so where that fails.
        working = os.getcwd()
        try:
            self._fmu = kind(
                guid=description.token,
                unzipDirectory=str(folder),
                modelIdentifier=description.identifier,
                instanceName=NAME,
            )
        finally:
            os.chdir(working)

    def _instantiate(self, fmi2: Any) -> None:
        note = self._note
        if self._version == 3:
            self._fmu.instantiate(logMessage=lambda _, status, category, message: note(message))
            return
        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda _, name, status, category, message: note(message))
        callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmi2.calloc)
        callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmi2.free)
        self._fmu.instantiate(callbacks=callbacks)

    def _note(self, message: bytes | None) -> None:
        """Keep the last message; the native code calls this, which must not raise."""
        # Twice what is shown, since a character may take several bytes.
        self._message = printable((message or b"")[:400].decode("utf-8", "replace"))

    def _call_guarded(self, what: str, run: Callable[[], None]) -> None:
        try:
            run()
        except Exception as error:  # FMPy raises plain exceptions
            self._ending()
            raise DataError(f"{self._where} cannot {what}: {printable(str(error))}{self._said()}") from error

    def _call(self, what: str, run: Callable[[], Any]) -> Any:
        self._message = ""
        try:
            return run()
        except Exception as error:  # FMPy raises plain exceptions
            raise SimulationError(f"{self._where} refuses {what}: {printable(str(error))}{self._said()}") from error

    def _said(self) -> str:
        return f"; it says: {self._message}" if self._message else ""
