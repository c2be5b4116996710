"""Parameters of an adaptation: options, and constants fitted to a run."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.settings.bounds import check_bounds, integer, span
from edp.settings.earlier_keys import present_keys
from edp.settings.tree import Table

Array = NDArray[np.float32]
FEATURE_LIMIT = 6.0
"""Standard widths at which inputs and features are cut off."""
CLIP = 3.0
"""Units beyond which an innovation teaches no more."""
MOST_ERROR = 20.0
"""Units beyond which an error counts no more when the correction is evaluated."""
BOUND = 4.0
"""Coefficients are held within so many prior spreads."""
BETTER = 0.01
"""Share by which the correction must be better than nothing to go out again."""
_KEYS_OF_DIGEST = {"dead_zone": "rest", "evaluation_s": "judged_s"}
"""Keys of earlier versions in the digest: a state that a controller of such a version saved contains its digest."""


@dataclass(frozen=True, kw_only=True)
class AdaptationSpec:
    """Speed and limits of an adaptation.

    Attributes:
        rank: r, directions of the inputs that corrections may use beside what they always use.
        forgetting_s: seconds of motion after which what was learned has 1/e of its weight.
        noise: variance of an error that nothing explains, in squared units (a unit is the spread of the run's errors);
            large, because errors of neighbouring ticks are nearly the same one: it sets how fast is learned.
        prior: spread of the coefficients, in units for one standard width of a feature.
        limit: largest correction, in units.
        dead_zone: share of the targets' spread from the middle within which the machine counts as in steady state.
        evaluation_s: seconds of motion over which the correction is evaluated against the prediction without it.
        margin: share by which it must be worse to be taken back.

    Raises:
        ConfigError: an option out of its range.
    """

    # 18 directions: 12 and 24 won alike on changed oil, 24 more on a changed dead band (decision 31).
    rank: int = 18
    forgetting_s: float = 60.0
    # 100 times the variance of the errors: errors of neighbouring ticks overlap in all but one sample (decision 31).
    noise: float = 100.0
    prior: float = 0.3
    limit: float = 3.0
    # At rest nothing is judged, and corrections learned in motion would stay in the output (decision 31).
    dead_zone: float = 0.05
    evaluation_s: float = 10.0
    margin: float = 0.05

    def __post_init__(self) -> None:
        reals = {entry.name: span(1e-3, 1e6) for entry in fields(self)[1:]}
        check_bounds("adaptation", self, rank=integer(0, 64), **(reals | {"dead_zone": span(0.0, 1e6)}))


@dataclass(frozen=True, eq=False, kw_only=True)
class Adaptation:
    """Constants of an adaptation; H horizons, J targets, I inputs, r directions, all arrays float32.

    The features of a horizon are ``phi = [1, (v - middle) / spread, (y - v) / change, e, Q (x - offset) / scale]``,
    each of them cut off at `FEATURE_LIMIT`: the measured targets v, what is predicted of them y, the errors e in units
    of the predictions that come due now (0 where none does), and directions Q of the inputs x. While nothing moves,
    by what is measured and by what is predicted, all of them are 0: so nothing is corrected or learned in steady state.

    Attributes:
        spec: options.
        rate_hz: ticks per second.
        horizons: ticks ahead, at least 1.
        columns: input that measures each target ``(J,)``.
        offset: offset of the inputs ``(I,)``, SI units.
        scale: standard width of the inputs ``(I,)``, SI units.
        directions: Q ``(r, I)``.
        middle: value of each target when nothing moves ``(J,)``, SI units.
        spread: standard width of each target ``(J,)``, SI units.
        change: standard width of ``y - v`` ``(H, J)``, SI units.
        unit: spread of the errors of the network ``(H, J)``, SI units.

    Raises:
        ConfigError: shapes that do not go together, widths that are not positive, or numbers that are not finite.
    """

    spec: AdaptationSpec
    rate_hz: float
    horizons: tuple[int, ...]
    columns: tuple[int, ...]
    offset: Array
    scale: Array
    directions: Array
    middle: Array
    spread: Array
    change: Array
    unit: Array

    def __post_init__(self) -> None:
        inputs, targets, ahead = len(self.offset), len(self.columns), len(self.horizons)
        shapes = {
            "scale": (inputs,),
            "directions": (self.spec.rank, inputs),
            "middle": (targets,),
            "spread": (targets,),
            "change": (ahead, targets),
            "unit": (ahead, targets),
        }
        for name, values in self.arrays().items():
            if values.shape != shapes.get(name, values.shape):
                raise ConfigError(f"adaptation: {name} has the shape {values.shape}, {shapes[name]} must hold")
            if values.dtype != np.float32 or not np.isfinite(values).all():
                raise ConfigError(f"adaptation: {name} must hold finite float32 numbers")
        for name in ("scale", "spread", "change", "unit"):
            if not (getattr(self, name) > 0).all():
                raise ConfigError(f"adaptation: {name} holds a width that is not positive")
        if not self.horizons or min(self.horizons) < 1 or not all(0 <= c < inputs for c in self.columns):
            raise ConfigError("adaptation: horizons must be at least 1, and columns places among the inputs")

    @property
    def features(self) -> int:
        """Number of features n, the length of phi."""
        return 1 + 3 * len(self.columns) + self.spec.rank

    @property
    def max_horizon(self) -> int:
        """The largest horizon in ticks."""
        return max(self.horizons)

    @property
    def numbers(self) -> dict[str, np.float32]:
        """Return the options as constants of the arithmetic.

        Coefficients follow ``theta' = a theta + w`` with ``a = exp(-1 / (forgetting rate))`` and a variance of w that
        keeps their spread at `prior`: so their covariance never exceeds ``prior^2`` in any direction.
        """
        # A forgetting time becomes a factor for each tick, whatever the sampling rate.
        forgetting = math.exp(-1.0 / (self.spec.forgetting_s * self.rate_hz))
        variance = self.spec.prior**2
        numbers = {
            "keep": forgetting,
            "keep_squared": forgetting * forgetting,
            # A sum of decay and refresh whose fixed point is the prior, so that P cannot wind up (decision 31).
            "refresh": (1.0 - forgetting * forgetting) * variance,
            "prior": variance,
            "noise": self.spec.noise,
            "limit": self.spec.limit,
            "bound": BOUND * self.spec.prior,
            "rate": 1.0 - math.exp(-1.0 / (self.spec.evaluation_s * self.rate_hz)),
            "worse": 1.0 + self.spec.margin,
            "better": 1.0 - BETTER,
        }
        return {name: np.float32(value) for name, value in numbers.items()}

    @property
    def dead_zone(self) -> Array:
        """Distance of each target from its middle beyond which the machine moves ``(J,)``, SI units."""
        return np.asarray(np.float32(self.spec.dead_zone) * self.spread, dtype=np.float32)

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by name."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def to_dict(self) -> Table:
        """Return everything but the arrays, as JSON gives it back."""
        columns, horizons = list(self.columns), list(self.horizons)
        return {"spec": asdict(self.spec), "rate_hz": self.rate_hz, "horizons": horizons, "columns": columns}

    @classmethod
    def from_dict(cls, plain: Table, arrays: Mapping[str, Array]) -> Adaptation:
        """Create an adaptation from `to_dict` and `arrays`.

        Raises:
            ConfigError: they do not go together.
            TypeError: an entry is missing or unknown.
        """
        # JSON has lists only; equality and hashing of an adaptation need tuples.
        entries: Table = {"horizons": tuple(plain["horizons"]), "columns": tuple(plain["columns"]), **arrays}
        return cls(
            spec=AdaptationSpec(**present_keys(AdaptationSpec, plain["spec"])), rate_hz=plain["rate_hz"], **entries
        )

    @property
    def digest(self) -> str:
        """Content address."""
        plain = self.to_dict()
        plain["spec"] = {_KEYS_OF_DIGEST.get(key, key): value for key, value in plain["spec"].items()}
        # Sorted, so that the digest depends on the content and not on the order of fields.
        state = hashlib.blake2b(repr(sorted(plain.items())).encode(), digest_size=16)
        for name, values in sorted(self.arrays().items()):
            state.update(repr((name, values.shape)).encode() + values.astype("<f4").tobytes())
        return state.hexdigest()

    @property
    def macs(self) -> int:
        """Multiply-accumulates of a tick that learns."""
        n, targets, inputs = self.features, len(self.columns), len(self.offset)
        # The covariance's product with phi, its update and its scale, and three inner products for each target.
        once = n * n + n * (n + 1) + n + 3 * targets * n
        return self.spec.rank * inputs + len(self.horizons) * once

    @property
    def state_numbers(self) -> int:
        """Numbers that it carries from tick to tick."""
        n, targets = self.features, len(self.columns)
        return sum(n * n + targets * (n + 3) + k * (n + 2 * targets) for k in self.horizons)
