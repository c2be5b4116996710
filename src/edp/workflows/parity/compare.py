"""The table of `edp parity`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from edp.data.unlabelled import unlabelled
from edp.errors import DataError, ExportError
from edp.export.golden import Rows, at_thresholds, random_inputs, stream, tolerance
from edp.logs.source import DataSource
from edp.training.bundle import Bundle
from edp.workflows.parity.base import FORMS, Broken, Missing, ParityCase, Row, compared


def golden_case(bundle: Bundle, ticks: int = 400, seed: int = 0) -> ParityCase:
    """Smooth random inputs in the usual range of each channel.

    Raises:
        DataError: fewer ticks than the window.
    """
    return _case(bundle, random_inputs(bundle.predictor, ticks, seed))


def recorded_case(bundle: Bundle, source: DataSource, ticks: int = 400) -> ParityCase:
    """The first ticks of the first recording of a source.

    Raises:
        DataError: a channel is missing or not finite, another rate, or fewer ticks than the window.
    """
    series = unlabelled(bundle.task, source.read()[0])
    return _case(bundle, np.ascontiguousarray(series.inputs[:ticks], dtype=np.float32))


def _case(bundle: Bundle, inputs: Rows) -> ParityCase:
    predictor = bundle.predictor
    if len(inputs) < predictor.spec.window:
        raise DataError(
            f"golden recording: {len(inputs)} ticks; it must hold at least a window, {predictor.spec.window}: give "
            "more ticks or a longer recording"
        )
    expected = stream(predictor, inputs)
    steps = at_thresholds(predictor, inputs)
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
