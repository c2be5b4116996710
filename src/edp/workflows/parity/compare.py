"""The table of `edp verify`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from edp.data.derived_velocities import matched
from edp.data.unlabelled import unlabelled
from edp.errors import DataError, ExportError
from edp.export.golden import Rows, grown_tolerance, random_inputs, relax_at_thresholds, stream, tolerance
from edp.logs.source import DataSource
from edp.networks.integer import IntegerPredictor
from edp.networks.twin import TwinPlant
from edp.recording import Recording
from edp.training.bundle import Bundle
from edp.workflows.parity.base import FORMS, Broken, Missing, ParityCase, Row, compared

TICKS = 400
"""Length of the golden recording of a network."""
FREE_S = 60.0
"""Length of the free run of a plant, behind its measured prefix."""


def golden_case(bundle: Bundle, ticks: int | None = None, seed: int = 0) -> ParityCase:
    """Smooth random inputs in the usual range of each channel; a plant is measured for its prefix, then runs free.

    Args:
        bundle: the network.
        ticks: length; by default `TICKS`, of a plant its prefix and `FREE_S`.
        seed: seed of the inputs.

    Raises:
        DataError: fewer ticks than the window.
    """
    return _case(bundle, random_inputs(bundle.predictor, ticks or _length(bundle), seed, mixed=False))


def _length(bundle: Bundle) -> int:
    predictor = bundle.predictor
    return predictor.window + round(FREE_S * bundle.task.rate_hz) if isinstance(predictor, TwinPlant) else TICKS


def record_case(bundle: Bundle, source: DataSource, ticks: int | None = None) -> ParityCase:
    """Return a case of the first ticks of each recording of a source, in equal parts, one after another.

    A plant runs free on the commands, after a measured prefix.

    Raises:
        DataError: a channel is missing or not finite, another rate, or fewer ticks than the window.
    """
    ticks = ticks or _length(bundle)
    recordings = source.read()[:ticks]
    part = -(-ticks // len(recordings))
    if isinstance(bundle.predictor, TwinPlant):
        return _case(bundle, _free_rows(bundle.predictor, recordings, part)[:ticks])
    rows = np.concatenate([unlabelled(bundle.task, recording).inputs[:part] for recording in recordings])
    return _case(bundle, np.ascontiguousarray(rows[:ticks], dtype=np.float32))


def _free_rows(plant: TwinPlant, recordings: Sequence[Recording], part: int) -> Rows:
    """Return the inputs of a plant along parts of recordings: measured for its prefix, free afterwards."""
    channels = plant.twin.channels
    series = [channels.task().series(matched(channels, recording), stop=part) for recording in recordings]
    inputs, targets = (np.concatenate([getattr(one, name) for one in series]) for name in ("inputs", "targets"))
    flags = np.zeros_like(targets)
    flags[: plant.window] = 1.0
    return np.concatenate([inputs, targets * flags, flags], axis=1, dtype=np.float32)


def _case(bundle: Bundle, inputs: Rows) -> ParityCase:
    predictor = bundle.predictor
    if len(inputs) < predictor.window:
        raise DataError(
            f"golden recording: {len(inputs)} ticks; it must hold at least a window, {predictor.window}: give "
            "more ticks or a longer recording"
        )
    expected = stream(predictor, inputs)
    steps = relax_at_thresholds(predictor, inputs)
    if isinstance(predictor, TwinPlant) and not isinstance(predictor, IntegerPredictor):
        return ParityCase(bundle, inputs, expected, grown_tolerance(predictor, inputs, expected))
    allowed = tolerance(predictor, inputs, expected)
    return ParityCase(bundle, inputs, expected, allowed + steps if steps.any() else allowed)


def compare(
    case: ParityCase,
    forms: Sequence[str] = (),
    interpreters: Sequence[str] = (),
    on_row: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Run every form, or those named, and compare each with PyTorch.

    Raises:
        ConfigError: an unknown form.
    """
    case = replace(case, interpreters=tuple(interpreters))
    rows: list[Row] = []
    for name in forms or list(FORMS):
        form = FORMS[name]()
        # Each form has an empty folder: files of one must not help another.
        with tempfile.TemporaryDirectory() as temporary:
            try:
                runs = form.run(case, Path(temporary))
                form_rows = [compared(name, f"{form.title}{more and ', '}{more}", case, ran) for more, ran in runs]
            except ExportError as error:
                form_rows = [Row(name, form.title, "refused", str(error))]
            except Missing as error:
                form_rows = [Row(name, form.title, "not run", str(error))]
            except Broken as error:
                form_rows = [Row(name, form.title, "failed", str(error))]
        for row in form_rows:
            on_row(row)
        rows += form_rows
    return rows
