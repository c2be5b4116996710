"""Registry of the kinds of runs: the files of each on disk, and the command that writes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

BUNDLE, TWIN, CONTROLLER = "bundle/bundle.json", "twin/twin.json", "controller/controller.json"
"""Headers of what runs make, with their arrays in the same folder."""


@dataclass(frozen=True)
class RunKind:
    """A kind of run.

    Attributes:
        name: name in `edp runs` and in `run.json`.
        command: command that writes such a run.
        result: file that only this kind of run has. Runs of earlier versions, which do not state their kind, are
            recognised by it.
        model: header of the model that a finished run has; empty for a kind without a model.
        lock: file that the process at work holds locked.
    """

    name: str
    command: str
    result: str
    model: str = ""
    lock: str = ".lock"


RUN_KINDS: Mapping[str, RunKind] = {
    kind.name: kind
    for kind in (
        RunKind("twin", "edp twin", TWIN, TWIN),
        RunKind("control", "edp loop run", CONTROLLER, CONTROLLER),
        RunKind("tuning", "edp loop tune", "tuning.json"),
        RunKind("search", "edp search", "study.json", lock="ledger/.lock"),
        RunKind("auto", "edp train --preset auto", "auto.json", BUNDLE),
        RunKind("pretraining", "edp train pretrain", "foundation.json", BUNDLE),
        RunKind("adaptation", "edp adapt", "adaptation.json", BUNDLE),
        RunKind("transfer", "edp train finetune", "transfer.json", BUNDLE),
        RunKind("compression", "edp compress search", "compression.json"),
        RunKind("monitor run", "edp monitor run", "alarms.jsonl"),
        RunKind("monitor", "edp monitor fit", "monitor.json", "monitor.json"),
        RunKind("identification", "edp calibrate", "identification.json"),
        RunKind("fleet", "edp train finetune --fleet", "fleet.json"),
        RunKind("network", "edp train", BUNDLE, BUNDLE),
    )
}
"""By name, in the order in which their results are looked for: the kinds whose run is also a network come before it."""
