"""Runs an adaptation tick by tick in NumPy, in single precision: the bits that the C code gives."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from edp.errors import ConfigError
from edp.ir.rls.constants import CLIP, FEATURE_LIMIT, MOST_ERROR, Adaptation, Array


class RlsStatus(IntEnum):
    """Result code of an adaptation step."""

    NONE = 0
    """No prediction is available for correction."""
    HOLDING = 1
    """The prediction is corrected without learning: in steady state, frozen, or after too few consecutive samples."""
    LEARNING = 2
    """The prediction is corrected, and the error of an earlier prediction has updated the correction."""
    FALLBACK = 3
    """At least one output is passed uncorrected, because its correction increased the error."""


@dataclass(frozen=True, eq=False)
class RlsState:
    """Learned state of an adaptation, to be stored over a restart.

    Attributes:
        digest: hash of the adaptation of this state.
        theta: coefficients ``(H, J, n)``.
    """

    digest: str
    theta: Array


def total(products: Array) -> Array:
    """Return sums over the last axis, added sequentially like a loop."""
    # `np.add.accumulate` adds in order; `np.sum` adds in pairs and would differ from C in the last bit.
    return np.asarray(np.add.accumulate(products, axis=-1, dtype=np.float32)[..., -1], dtype=np.float32)


class RlsCorrector:
    """Online correction of predictions by recursive least squares.

    With the error ``e = (v(t) - y(t - k)) / unit`` of the prediction that has just come due, P for ``P = P(t - 1)``
    and ``phi = phi(t - k)``, a tick in motion does (a Kalman filter on coefficients that fade with time)::

        g = P phi,  d = noise + phi' g
        theta = a (theta + g clip(e - theta phi) / d)
        P = a^2 (P - g g' / d) + (1 - a^2) prior^2 I

    and each tick gives ``y + unit clip(theta phi(t))``. One P serves all targets of a horizon. With `a` below 1 nothing
    winds up: without excitation P goes back to its start, and so does theta.

    Args:
        adaptation: the constants.

    Attributes:
        theta: coefficients ``(H, J, n)``.
        covariance: P of each horizon ``(H, n, n)``.
        fallback: mask of the outputs without correction ``(H, J)``.
        repairs: number of restarts because coefficients or a covariance were invalid; 0 in normal operation.
    """

    def __init__(self, adaptation: Adaptation) -> None:
        self.adaptation, self._numbers = adaptation, adaptation.numbers
        self._columns = list(adaptation.columns)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        constants = self.adaptation
        ahead, targets, n = len(constants.horizons), len(constants.columns), constants.features
        self.theta = np.zeros((ahead, targets, n), dtype=np.float32)
        # One covariance for all targets of a horizon: they share their features (decision 31).
        self.covariance = np.stack([self._start()] * ahead)
        self._plain, self._corrected = (np.zeros((ahead, targets), dtype=np.float32) for _ in range(2))
        self.fallback = np.zeros((ahead, targets), dtype=bool)
        self._rows = [np.zeros((k, n + 2 * targets), dtype=np.float32) for k in constants.horizons]
        self._at = [0] * ahead
        self.repairs = self._streak = 0

    def interrupt(self) -> None:
        """Report missing samples: predictions made before them are not compared; learned coefficients stay."""
        self._streak = 0

    @property
    def learned(self) -> RlsState:
        """Return the learned state."""
        return RlsState(self.adaptation.digest, self.theta.copy())

    def restore(self, learned: RlsState) -> None:
        """Restore an earlier learned state.

        Raises:
            ConfigError: it belongs to another adaptation, or holds numbers out of their bounds.
        """
        if learned.digest != self.adaptation.digest or learned.theta.shape != self.theta.shape:
            raise ConfigError("what was learned belongs to another adaptation; start from nothing instead")
        # A coefficient beyond its bound cannot come from learning; the file was changed or damaged.
        if not (np.abs(learned.theta) <= self._numbers["bound"]).all():
            raise ConfigError("what was learned is damaged: a coefficient is out of its bounds; start from nothing")
        self.theta = learned.theta.astype(np.float32)

    def step(
        self, inputs: ArrayLike, prediction: ArrayLike, fresh: bool = True, learn: bool = True
    ) -> tuple[Array, RlsStatus]:
        """Learn from predictions that are now due, and correct a prediction.

        Args:
            inputs: inputs of this sample ``(I,)``, SI units.
            prediction: prediction of the network from these inputs ``(H, J)``, SI units.
            fresh: whether the inputs belong to the current sample and the prediction uses a whole window.
            learn: whether the correction learns; False keeps it constant, and it is still evaluated.

        Returns:
            The corrected prediction ``(H, J)`` in SI units, and the status. Values that are not finite are returned
            unchanged.
        """
        x, y = np.asarray(inputs, dtype=np.float32), np.asarray(prediction, dtype=np.float32)
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            self.interrupt()
            return y.copy(), RlsStatus.NONE
        # Overflow is met by the limits behind it, as in C, where it raises no warning.
        with np.errstate(over="ignore"):
            return self._step(x, y, fresh, learn)

    def _step(self, x: Array, y: Array, fresh: bool, learn: bool) -> tuple[Array, RlsStatus]:
        constants, out, taught = self.adaptation, y.copy(), False
        measured, directed = x[self._columns], self._project_inputs(x)
        for h, k in enumerate(constants.horizons):
            error = np.zeros(len(measured), dtype=np.float32)
            # The prediction made k samples ago is evaluated only if no sample is missing since then.
            if fresh and self._streak >= k:
                error = self._error(h, measured)
                taught = self._due(h, error, learn) or taught
            phi = self._phi(h, measured, y[h], error, directed)
            correction = self._correction(h, phi)
            if fresh:
                self._rows[h][self._at[h]] = np.concatenate([phi, y[h], correction])
                self._at[h] = (self._at[h] + 1) % k
            out[h] = np.where(self.fallback[h], y[h], y[h] + constants.unit[h] * correction)
        # The streak saturates: a counter that grows for months would overflow in C.
        self._streak = min(self._streak + 1, constants.max_horizon) if fresh else 0
        if self.fallback.any():
            return out, RlsStatus.FALLBACK
        return out, RlsStatus.LEARNING if taught else RlsStatus.HOLDING

    def _project_inputs(self, x: Array) -> Array:
        """Return the projections of the inputs on the directions ``(r,)``."""
        constants = self.adaptation
        if not constants.spec.rank:
            return np.zeros(0, dtype=np.float32)
        scaled = _clip((x - constants.offset) / constants.scale, FEATURE_LIMIT)
        return _clip(total(constants.directions * scaled), FEATURE_LIMIT)

    def _phi(self, h: int, measured: Array, y: Array, error: Array, directed: Array) -> Array:
        constants = self.adaptation
        if not (self._moves(measured) or self._moves(y)):
            return np.zeros(constants.features, dtype=np.float32)
        present = _clip((measured - constants.middle) / constants.spread, FEATURE_LIMIT)
        change = _clip((y - measured) / constants.change[h], FEATURE_LIMIT)
        return np.concatenate([np.ones(1, dtype=np.float32), present, change, _clip(error, FEATURE_LIMIT), directed])

    def _moves(self, values: Array) -> bool:
        """Return whether a target is outside its dead zone around the middle."""
        return bool((np.abs(values - self.adaptation.middle) > self.adaptation.dead_zone).any())

    def _error(self, h: int, measured: Array) -> Array:
        """Return the error in units ``(J,)`` of the prediction that comes due."""
        n, row = self.adaptation.features, self._rows[h][self._at[h]]
        return np.asarray((measured - row[n : n + len(measured)]) / self.adaptation.unit[h])

    def _correction(self, h: int, phi: Array) -> Array:
        """Return the correction in target units ``(J,)``.

        Coefficients that are not finite (damaged memory) are cleared.
        """
        correction = total(self.theta[h] * phi)
        damaged = ~np.isfinite(correction)
        if damaged.any():
            self.theta[h][damaged], correction[damaged] = 0.0, 0.0
            self.repairs += 1
        return _clip(correction, self._numbers["limit"])

    def _due(self, h: int, error: Array, learn: bool) -> bool:
        """Evaluate, and learn from, the prediction that has come due; returns whether something was learned."""
        n, row = self.adaptation.features, self._rows[h][self._at[h]]
        # The constant feature is 1 in motion, so a zero there says that the row was made at rest.
        if row[0] == 0:  # at rest
            return False
        self._judge(h, error, row[n + len(error) :], learn)
        return learn and self._learn(h, row[:n], error)

    def _judge(self, h: int, error: Array, correction: Array, learn: bool) -> None:
        """Compare the running errors without and with the correction; disable or enable the correction."""
        constants, most = self._numbers, np.float32(MOST_ERROR)
        for running, of in ((self._plain[h], error), (self._corrected[h], error - correction)):
            # Limit single errors, so that one spike does not decide about the correction.
            running += constants["rate"] * (np.minimum(np.abs(of), most) - running)
        worse = ~self.fallback[h] & (self._corrected[h] > constants["worse"] * self._plain[h])
        better = self.fallback[h] & (self._corrected[h] < constants["better"] * self._plain[h])
        self.fallback[h] = (self.fallback[h] | worse) & ~better
        if learn and worse.any():
            # Reset a correction that increased the error to zero, and its mean error to the error without correction.
            self.theta[h][worse] = 0.0
            self._corrected[h][worse] = self._plain[h][worse]
            self.covariance[h] = self._start()

    def _learn(self, h: int, phi: Array, error: Array) -> bool:
        constants, p = self._numbers, self.covariance[h]
        g = total(p * phi)
        d = constants["noise"] + total(phi * g)
        # The negated comparison also catches NaN.
        if not d >= constants["noise"]:
            self._repair(h)
            return False
        inverse = np.float32(1.0) / d
        # Clip the innovation and not the error: outliers count in the comparison but do not change the coefficients
        # much.
        innovation = _clip(error - total(self.theta[h] * phi), CLIP)
        step = (innovation * inverse)[:, None]
        self.theta[h] = _clip(constants["keep"] * (self.theta[h] + g * step), constants["bound"])
        p = constants["keep_squared"] * (p - (g[:, None] * g) * inverse)
        diagonal = np.einsum("ii->i", p)
        diagonal += constants["refresh"]
        self.covariance[h] = p
        # Rounding may cost the covariance its positive diagonal; the prior replaces it then.
        if not ((diagonal > 0) & (diagonal <= np.float32(2.0) * constants["prior"])).all():
            self._repair(h)
        return True

    def _repair(self, h: int) -> None:
        self.covariance[h] = self._start()
        self.repairs += 1

    def _start(self) -> Array:
        return np.eye(self.adaptation.features, dtype=np.float32) * self._numbers["prior"]


def _clip(values: Array, limit: float | np.floating) -> Array:
    """Limit values to plus and minus `limit`."""
    bound = np.float32(limit)
    return np.asarray(np.minimum(np.maximum(values, -bound), bound), dtype=np.float32)
