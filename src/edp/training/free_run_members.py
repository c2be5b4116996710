"""Training the members of a recurrent twin apart, each from a seed of its own, and averaging them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.networks.twin import TwinScales
from edp.networks.twin.recurrent import Recurrent, RecurrentTwin, averaged, member_seed
from edp.networks.twin.static_map import StaticTwin
from edp.storage.runs import KeyedRun, part_of
from edp.training.free_run import FittedTwin, FreeRunProgress, FreeRunSpec, fit_free_runs


def fit_members(
    form: Recurrent,
    parts: tuple[TwinChannels, TwinScales, StaticTwin | None],
    series: tuple[Sequence[Series], Sequence[Series]],
    training: FreeRunSpec,
    on_event: Callable[[FreeRunProgress], None] | None = None,
    run: KeyedRun | None = None,
) -> FittedTwin:
    """Train each member of a recurrent twin on free runs of its own, and average them.

    Args:
        form: its options.
        parts: channels, scales, and the fitted static map that all members share, where there is one.
        series: training stretches, and those that choose among the weights of each member.
        training: how; the first member has its seed, the others one of their own.
        on_event: called with progress of each member in turn.
        run: folder and key of the run; where given, each member's training is resumable.
    """
    fits = []
    for which in range(form.members):
        seed = member_seed(training.seed, which)
        twin = form.member(*parts, seed)
        with part_of(run, f"member_{which}" if form.members > 1 else "") as own:
            fits.append(fit_free_runs(twin, *series, replace(training, seed=seed), on_event, own))
    return joined_members(fits)


def joined_members(fits: Sequence[FittedTwin]) -> FittedTwin:
    """Members that were trained apart, on one map and with one scale, as one twin.

    Returns:
        The average, the rows of all trainings one behind the other (each with its ``member`` where there are
        several), and the processor time of all.
    """
    if len(fits) == 1:
        return fits[0]
    rows = [row | {"member": which} for which, fit in enumerate(fits) for row in fit.history]
    twins = [fit.twin for fit in fits if isinstance(fit.twin, RecurrentTwin)]
    return FittedTwin(averaged(twins), rows, sum(fit.seconds for fit in fits))
