"""Methods that keep the domain of the source: one set of weights for both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import ClassVar

from edp.data.series import Series
from edp.errors import ConfigError
from edp.training.transfer.both_domains import BothDomains, BothSpec
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network, size_of


@METHODS.register("rehearsal")
class Rehearsal:
    """Everything learns from the target's logs and the source's recordings together."""

    label: ClassVar[str] = "Rehearsal"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = True
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Train on both domains."""
        return train_both(case, "rehearsal", BothSpec(weight=case.spec.source_weight))


@METHODS.register("rehearsal_distilled")
class DistilledRehearsal:
    """Rehearsal in which the source's own network teaches a share of its domain."""

    label: ClassVar[str] = "Rehearsal, distilled"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = True
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Train on both domains."""
        spec = BothSpec(weight=case.spec.source_weight, soft=case.spec.soft)
        return train_both(case, "rehearsal_distilled", spec)


@METHODS.register("adversarial")
class Adversarial:
    """Rehearsal with a classifier of domains on the backbone's features, whose gradient is reversed (5.5.1)."""

    label: ClassVar[str] = "Rehearsal, adversarial"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = True
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Train on both domains."""
        spec = BothSpec(weight=case.spec.source_weight, reversal=case.spec.reversal)
        return train_both(case, "adversarial", spec)


def train_both(case: TransferCase, name: str, spec: BothSpec) -> Made:
    """Train on both domains; the best epoch is chosen on as many validation ticks of the one as of the other.

    Raises:
        ConfigError: the recordings of the source are not at hand.
    """
    source = case.source
    if source.data is None:
        raise ConfigError(f"method '{name}' needs the recordings of the source: {source.absent}")
    source_series = source.data.train
    # Four start-ups at least: a shorter piece would judge its beginning alone.
    least = 4 * (
        max(source.predictor.spec.window, case.experiment.training.chunks.burn_in) + case.data.task.max_horizon
    )
    judged = share(source.data.validation, sum(part.samples for part in case.data.validation), least)
    network = case.train(
        name,
        case.tuning(),
        lambda: BothDomains(source.predictor, source_series, spec),
        asdict(spec),
        judged=judged,
        centred=False,
    )
    return of_network(network, size_of(network))


def share(series: Sequence[Series], ticks: int, least: int) -> list[Series]:
    """The beginnings of as many series as `ticks` ticks suffice for, each of `least` ticks or more, spread over all."""
    # As many ticks of the source as of the target: the larger domain must not choose the epoch alone.
    count = max(1, min(len(series), ticks // least))
    size = max(least, ticks // count)
    chosen = [series[i * len(series) // count] for i in range(count)]
    return [replace(one, inputs=one.inputs[:size], targets=one.targets[:size]) for one in chosen]
