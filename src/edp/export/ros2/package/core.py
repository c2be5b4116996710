"""The network in C behind ctypes, and the rules by which messages become its ticks. Needs Python and a C compiler only.

Nothing here knows ROS: messages are dimensionless values with a time. `node.py` is the thin part that does.
"""

from __future__ import annotations

import ctypes
import json
import math
import subprocess
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from time import perf_counter

HERE = Path(__file__).resolve().parent
LIBRARY = "libcore.so"
LATE_TICKS = 2.0
"""Maximum age of a pressure in samples."""
RATE_TOLERANCE = 0.1
"""Maximum relative difference between the median message interval and the sample interval."""
RATE_MESSAGES = 11
"""Number of messages over which the rate is evaluated."""
LOOPED_S = 1.0
"""Backward time step in s above which a new recording is assumed instead of a late message."""


class CallStatus(IntEnum):
    """Result code of the C functions; see their header."""

    OK = 0
    WARMING = 1
    HELD = 2
    RESTARTED = 3
    NOT_RESET = 4


def build(compiler: str = "cc", folder: Path = HERE) -> Path:
    """Compile the C code next to this file.

    Raises:
        RuntimeError: the compiler is missing or says no.
    """
    library, sources = folder / LIBRARY, sorted(str(path) for path in (folder / "csrc").glob("*.c"))
    command = [
        compiler,
        "-std=c99",
        "-O2",
        "-ffp-contract=off",
        "-shared",
        "-fPIC",
        *sources,
        "-lm",
        "-o",
        str(library),
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise RuntimeError(f"compiler '{compiler}' does not start ({error}); install one or set CC") from error
    if done.returncode:
        raise RuntimeError(f"'{compiler}' cannot compile {folder / 'csrc'}:\n{done.stderr[-2000:]}")
    return library


class Core:
    """One machine's network with its state.

    Attributes:
        about: the description that was exported with it.
        inputs: names of the inputs, in order.
        results: names of the results, each with its numbers.

    Raises:
        FileNotFoundError: the library was not built.
    """

    def __init__(self, folder: Path = HERE) -> None:
        self.about = json.loads((folder / "model.json").read_text())
        library = folder / LIBRARY
        if not library.exists():
            raise FileNotFoundError(f"{library} is missing; build the package, or run the module `build` of this one")
        self._c, name = ctypes.CDLL(str(library)), self.about["name"]
        self._reset, self._step = self._c[f"{name}_reset"], self._c[f"{name}_step"]
        self._missed, size = self._c[f"{name}_missed"], self._c[f"{name}_state_bytes"]
        size.restype = ctypes.c_uint32
        self.inputs = [channel["name"] for channel in self.about["inputs"]]
        shapes = self.about["results"]
        self.results = {meaning: shape[0] * shape[1] for meaning, shape in shapes.items()}
        self._out = (ctypes.c_float * sum(self.results.values()))()
        self._state = (ctypes.c_uint64 * (size() // 8 + 1))()
        self.reset()

    def reset(self) -> None:
        """Forget the past and the counts."""
        self._reset(self._state)

    def step(self, row: list[float]) -> CallStatus:
        """Return one tick; `row` in SI units, in the order of `inputs`.

        Raises:
            ValueError: it has another length.
        """
        if len(row) != len(self.inputs):
            raise ValueError(f"a tick has {len(row)} numbers; the network reads {len(self.inputs)}")
        c_row = (ctypes.c_float * len(row))(*row)
        return CallStatus(self._step(self._state, c_row, self._out))

    def missed(self, ticks: int) -> CallStatus:
        """Report the number of samples without inputs."""
        return CallStatus(self._missed(self._state, ctypes.c_uint32(min(ticks, 2**31)), self._out))

    def result(self, meaning: str = "prediction") -> list[list[list[float]]]:
        """Return the last result: ``[interval][horizon][target]``; a prediction has one interval."""
        at = 0
        for name, count in self.results.items():
            if name == meaning:
                ahead, wide = len(self.about["horizons"]), len(self.about["targets"])
                rows = [list(self._out[i : i + wide]) for i in range(at, at + count, wide)]
                return [rows[i : i + ahead] for i in range(0, len(rows), ahead)]
            at += count
        raise KeyError(meaning)

    @property
    def counts(self) -> dict[str, int]:
        """Since the last reset: ticks, rejected inputs, held ticks, restarts."""
        first = ctypes.cast(self._state, ctypes.POINTER(ctypes.c_uint32))
        return {name: first[i] for i, name in enumerate(("ticks", "rejected", "held", "restarts"))}


@dataclass(frozen=True)
class InputSource:
    """Source of an input.

    Attributes:
        kind: ``position``, ``velocity`` or ``effort`` of a joint, ``pressure`` of a sensor, or ``constant``.
        name: name of the joint or sensor.
        value: value of a constant.
    """

    kind: str
    name: str = ""
    value: float = math.nan


KINDS = ("position", "velocity", "effort", "pressure", "constant")


def read_sources(inputs: list[str], texts: list[str]) -> dict[str, InputSource]:
    """Parse input sources such as ``CylVels_1=velocity:boom``, ``BmUp=pressure:boom_up``, ``Load=constant:0``.

    Raises:
        ValueError: inputs without a source, sources without an input, or a text of another form; all of them are named.
    """
    input_sources: dict[str, InputSource] = {}
    wrong = []
    for text in filter(None, texts):
        name, _, origin = text.partition("=")
        kind, _, what = origin.partition(":")
        if kind not in KINDS or not what or name in input_sources:
            wrong.append(f"'{text}' (once each: INPUT=KIND:NAME with a kind of {', '.join(KINDS)})")
        elif kind == "constant":
            try:
                input_sources[name] = InputSource(kind, value=float(what))
            except ValueError:
                wrong.append(f"'{text}' ({what} is no number)")
        else:
            input_sources[name] = InputSource(kind, what)
    missing = [name for name in inputs if name not in input_sources]
    unknown = [name for name in input_sources if name not in inputs]
    problems = [
        f"{what}: {', '.join(names)}"
        for what, names in (("not read", wrong), ("inputs without a source", missing), ("no input", unknown))
        if names
    ]
    if problems:
        raise ValueError(f"sources: {'; '.join(problems)}; the network reads {', '.join(inputs)}")
    return input_sources


@dataclass
class Tick:
    """Result of a joint message.

    Attributes:
        status: status of the C code; None if the message gave no sample.
        valid: the prediction rests on this tick's inputs and on a whole window, at the network's rate.
        why: reason why the result is not valid.
        missed: number of samples that were missed before this sample.
        step_us: time of the C code, microseconds.
    """

    status: CallStatus | None
    valid: bool
    why: str = ""
    missed: int = 0
    step_us: float = 0.0

    @property
    def predicted(self) -> bool:
        """Whether there is a prediction."""
        return self.status in (CallStatus.OK, CallStatus.WARMING, CallStatus.HELD)


@dataclass
class Assembler:
    """Makes ticks of messages: each message of joints is a tick; pressures are the newest ones.

    Attributes:
        core: the network.
        sources: sources of its inputs.
        rejected: messages that no tick was made of: late, twice, or at a wrong rate.
    """

    core: Core
    sources: dict[str, InputSource]
    rejected: int = 0
    _pressures: dict[str, tuple[float, float]] = field(default_factory=dict)
    _last: float | None = None
    _heard: float | None = None
    _gaps: deque[float] = field(default_factory=lambda: deque(maxlen=RATE_MESSAGES))

    @property
    def tick_s(self) -> float:
        """Seconds of a tick."""
        return 1.0 / float(self.core.about["rate_hz"])

    def pressure(self, name: str, value: float, stamp: float) -> None:
        """Store a pressure in Pa, measured at `stamp` s; a value older than the stored one is ignored."""
        latest = self._pressures.get(name)
        if latest is None or stamp >= latest[1] or latest[1] - stamp > LOOPED_S:
            self._pressures[name] = (value, stamp)

    def joints(
        self, names: list[str], position: list[float], velocity: list[float], effort: list[float], stamp: float
    ) -> Tick:
        """Process a joint message at `stamp` s as one sample."""
        if self._heard is not None:
            if stamp - self._heard < -LOOPED_S:
                self.core.reset()
                self._gaps.clear()
                self._last = None
            else:
                self._gaps.append(max(stamp - self._heard, 0.0))
        self._heard = stamp
        gap = self.tick_s if self._last is None else stamp - self._last
        if gap < 0.5 * self.tick_s:
            self.rejected += 1
            soon = f"a message {1000 * gap:.1f} ms after the last tick is no tick"
            return Tick(None, False, self._wrong_rate() or soon)
        self._last = stamp
        missed = max(0, round(gap / self.tick_s) - 1)
        wrong = self._wrong_rate()
        if wrong:
            self.rejected += 1
            self.core.reset()
            return Tick(None, False, wrong, missed)
        began = perf_counter()
        if missed:
            self.core.missed(missed)
        row, reason = self._row(dict(zip(names, range(len(names)))), (position, velocity, effort), stamp)
        status = self.core.step(row)
        spent = 1e6 * (perf_counter() - began)
        if status is CallStatus.OK:
            reason = "" if len(self._gaps) == RATE_MESSAGES else "too few messages to know their rate"
        else:
            reason = reason or _why(status)
        return Tick(status, not reason, reason, missed, spent)

    def _wrong_rate(self) -> str:
        """Return a description of a wrong message rate; empty if the rate is correct."""
        if len(self._gaps) < RATE_MESSAGES:
            return ""
        middle = sorted(self._gaps)[len(self._gaps) // 2]
        if abs(middle - self.tick_s) <= RATE_TOLERANCE * self.tick_s:
            return ""
        seen = f"{1 / middle:.1f} Hz" if middle > 0 else "with equal times"
        return f"messages come at {seen}; the network was trained at {1 / self.tick_s:g} Hz"

    def _row(
        self, at: dict[str, int], fields: tuple[list[float], list[float], list[float]], stamp: float
    ) -> tuple[list[float], str]:
        """Return the inputs of the sample; missing inputs are NaN, which the C code rejects."""
        row, absent = [], []
        for name, source in self.sources.items():
            value = source.value
            if source.kind == "pressure":
                value, when = self._pressures.get(source.name, (math.nan, -math.inf))
                value = value if abs(stamp - when) <= LATE_TICKS * self.tick_s else math.nan
            elif source.kind != "constant":
                values = fields[KINDS.index(source.kind)]
                value_index = at.get(source.name, len(values))
                value = values[value_index] if value_index < len(values) else math.nan
            row.append(float(value))
            if not math.isfinite(value):
                absent.append(f"{name} ({source.kind} of {source.name})")
        ordered = dict(zip(self.sources, row))
        why = f"missing, too old or not finite: {', '.join(absent)}" if absent else ""
        return [ordered[name] for name in self.core.inputs], why


def _why(status: CallStatus) -> str:
    return {
        CallStatus.WARMING: "fewer ticks than a window since the reset",
        CallStatus.HELD: "an input is beyond its limits; the last accepted ones were held",
        CallStatus.RESTARTED: "too many ticks without inputs, or a result that is not finite: started anew",
    }.get(status, "not reset")
