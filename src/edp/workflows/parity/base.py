"""Forms of a network that run on this computer: the registry and its interface."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np

from edp.export.golden import SHARE, Rows, relax_at_thresholds, stream
from edp.registry import Registry
from edp.sandbox.environment import BUILD_NAMES, reduce_environment
from edp.training.bundle import Bundle

NAME = "predictor"
# The least of three rounds: other work on the machine only ever adds time.
ROUNDS = 3


class Missing(Exception):
    """Error of a form that this computer cannot run; the text names the requirement."""


class Broken(Exception):
    """Error of a form that did not build, or failed; the text gives the reason."""


@dataclass(frozen=True, eq=False)
class ParityCase:
    """Input of every form.

    Attributes:
        bundle: the trained network.
        inputs: golden recording ``(tick, input)``, SI units.
        expected: streaming results of PyTorch for the input, ``(tick, number)``: predictions, then lower and upper
            bounds, SI units.
        allowed: tolerance of a form, ``(number,)``, or ``(tick, number)`` for trees near their thresholds.
        interpreters: Python programs with another ONNX Runtime.
    """

    bundle: Bundle
    inputs: Rows
    expected: Rows
    allowed: Rows
    interpreters: tuple[str, ...] = ()

    @property
    def window(self) -> int:
        """Ticks of a window."""
        return self.bundle.predictor.window

    def last_windows(self, count: int) -> tuple[list[Rows], Rows, Rows]:
        """Return windows at the end of the recording, PyTorch's prediction for each one alone, and the tolerance.

        Returns:
            Inputs ``(tick, input)`` of each; ``(window, number)`` twice.
        """
        ends = range(max(self.window, len(self.inputs) - count + 1), len(self.inputs) + 1)
        windows = [np.ascontiguousarray(self.inputs[end - self.window : end]) for end in ends]
        predictor = self.bundle.predictor
        # The least over the ticks is what is allowed where no tree is at a threshold.
        least = self.allowed if self.allowed.ndim == 1 else self.allowed.min(axis=0)
        allowed = [least + relax_at_thresholds(predictor, window)[-1] for window in windows]
        return windows, np.concatenate([stream(predictor, window)[-1:] for window in windows]), np.stack(allowed)


@dataclass(frozen=True, eq=False)
class Ran:
    """Result of a form on the golden recording.

    Attributes:
        numbers: its numbers ``(row, number)``, SI units.
        seconds: time per sample, or per window if the form computes windows.
        expected: expected values, if they differ from PyTorch's stream.
        allowed: tolerance, ``(number,)`` or ``(row, number)``; None for the tolerance of the case.
        note: a remark for the table.
    """

    numbers: Rows
    seconds: float
    expected: Rows | None = None
    allowed: Rows | None = None
    note: str = ""


class Form(Protocol):
    """A form in which a network can be run; its registered class takes no arguments."""

    title: ClassVar[str]

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """Export into `folder`, which is empty, and run.

        Returns:
            Runs with a remark for the title, empty for the only one; several where there are several versions.

        Raises:
            ExportError: the network has no such form; the reason is shown.
            Missing: a program or package is not there.
            Broken: the exported files do not build, or the program failed.
        """
        ...


FORMS: Registry[type[Form]] = Registry("form")


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        form: name in the registry.
        title: name of the form for readers.
        verdict: ``same``, ``different``, ``failed``, ``refused`` (no such form of this network) or ``not run``.
        why: reason for the last three states.
        largest: difference, in what is allowed; of numbers that must be equal, how many differ.
        mean: difference, in the same.
        tolerance: `edp.export.golden.SHARE`, which `tolerance` explains, or ``bits``.
        microseconds: time per sample (or window).
        note: a remark.
    """

    form: str
    title: str
    verdict: str
    why: str = ""
    largest: float | None = None
    mean: float | None = None
    tolerance: str = ""
    microseconds: float | None = None
    note: str = ""

    def to_json(self) -> dict[str, object]:
        """Return the plain values."""
        return dict(vars(self))


def compared(form: str, title: str, case: ParityCase, ran: Ran) -> Row:
    """Compare the outputs of a form with the expected outputs."""
    expected = case.expected if ran.expected is None else ran.expected
    allowed = case.allowed if ran.allowed is None else ran.allowed
    computed = np.asarray(ran.numbers, dtype=np.float64)
    rest = {"microseconds": 1e6 * ran.seconds, "note": ran.note}
    if computed.shape != expected.shape:
        why = f"shape {computed.shape} instead of {expected.shape}"
        return Row(form, title, "different", why, **rest)  # type: ignore[arg-type]
    apart = np.abs(computed - expected)
    # A tolerance of zero asks for equal bits.
    exact = not allowed.any()
    share = (computed != expected).astype(float) if exact else apart / allowed
    # NaN compares false with everything and would pass as equal.
    share = np.where(np.isfinite(computed), share, np.inf)
    largest = float(share.sum() if exact else share.max())
    same = largest == 0.0 if exact else largest <= 1.0
    bound = "bits" if exact else f"{SHARE:.0e}"
    verdict = "same" if same else "different"
    return Row(form, title, verdict, "", largest, float(share.mean()), bound, **rest)  # type: ignore[arg-type]


def need(program: str, package: str) -> str:
    """Return the path of a program.

    Raises:
        Missing: it is not there.
    """
    program_path = shutil.which(program)
    if program_path is None:
        raise Missing(f"needs {program} (Debian package {package})")
    return program_path


def called(command: Sequence[object], folder: Path, feed: bytes = b"") -> bytes:
    """Return the standard output of a program.

    Raises:
        Broken: it failed; the text ends with what it said last.
    """
    # A bundle's author may have written what runs here: it sees no secret of this process's environment.
    environment = reduce_environment(BUILD_NAMES)
    line = [str(part) for part in command]
    done = subprocess.run(line, cwd=folder, input=feed, capture_output=True, env=environment)
    if done.returncode:
        # The last lines tell the cause; compilers write thousands before them.
        output = (done.stdout + done.stderr).decode(errors="replace").strip()[-600:]
        raise Broken(f"{Path(str(command[0])).name} ended with {done.returncode}: {output}")
    return done.stdout


def timed(run: Callable[[], Rows]) -> tuple[Rows, float]:
    """Return the result of a run, and the least seconds of several rounds."""
    spent = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        result = run()
        spent.append(time.perf_counter() - began)
    return result, min(spent)
