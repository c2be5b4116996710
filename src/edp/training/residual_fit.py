"""Free-run training of the network of a residual twin on a fitted grey box; it is used only if it helps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from edp.data.series import Series
from edp.networks.twin.residual import Residual, ResidualTwin
from edp.storage.runs import KeyedRun
from edp.training.fitted_twin import FittedTwin, FreeRunProgress
from edp.training.free_run import FreeRunSpec, FreeRunValidation, fit_free_runs


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualFit(FittedTwin):
    """A trained residual twin: the grey box alone if the weights of the best validation do not help.

    Attributes:
        twin: the twin that is used.
        grey_error: mean error of the velocities over the free runs of the validation part, in deviations, of the grey
            box alone.
        error: free-run error with the network.
    """

    twin: ResidualTwin
    grey_error: float
    error: float

    @property
    def helps(self) -> bool:
        """Whether the network has less error than the grey box alone; otherwise its output is zero."""
        return self.error < self.grey_error


def residual_spec(form: Residual, training: FreeRunSpec) -> FreeRunSpec:
    """Return the training settings of the network: common twin settings with changes for this formulation."""
    return replace(
        training,
        batch=form.batch,
        lengths_s=form.lengths_s,
        updates=form.updates,
        validate_every=form.validate_every,
    )


def fit_residual(
    twin: ResidualTwin,
    form: Residual,
    train: Sequence[Series],
    validation: Sequence[Series],
    training: FreeRunSpec,
    on_event: Callable[[FreeRunProgress], None] | None = None,
    run: KeyedRun | None = None,
) -> ResidualFit:
    """Train the network on a grey box with fixed, fitted parameters.

    Args:
        twin: its network untrained; it is changed.
        form: formulation, which says how long is trained on what.
        train: training segments.
        validation: segments that choose among the weights on the way, and between network and none.
        training: settings that all twins share.
        on_event: called with progress, after each validation.
        run: folder and key of the run; where given, a stopped training goes on.

    Raises:
        DataError: segments that are too short.
        FreeRunDiverged: a gradient is not finite any more.
    """
    spec = residual_spec(form, training)
    ticks = round(spec.validation_s * twin.channels.rate_hz)
    grey_error = FreeRunValidation(twin.drop_network(), validation, ticks, spec.batch).error()
    fitted = fit_free_runs(twin, train, validation, spec, on_event, run)
    error = min(row["validation"] for row in fitted.history)
    chosen = twin if error < grey_error else twin.drop_network()
    facts = {"helps": error < grey_error, "validation": error, "validation_grey_box": grey_error}
    return ResidualFit(
        twin=chosen, history=fitted.history, seconds=fitted.seconds, facts={"residual": facts}, grey_error=grey_error,
        error=error,
    )  # fmt: skip
