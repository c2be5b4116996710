"""Size limits of the generated code, checked before anything is written."""

from __future__ import annotations

import math
from collections.abc import Mapping

from edp.errors import ExportError
from edp.training.bundle import Bundle

LARGEST = 2**31 - 1
"""Maximum number of bytes, values and samples: C counts in ``uint32_t``, MATLAB, Simulink and FMI in ``int32_t``."""
MAX_COLUMNS = 2**16
"""Maximum width of a value from which a column table selects, because its entries are ``uint16_t``."""


def check_numbers(bundle: Bundle) -> None:
    """Refuse a rate, horizons or coverages that no generated code can state.

    Raises:
        ExportError: a value cannot be stated; the message names it and the rule.
    """
    rate, horizons, coverages = bundle.task.rate_hz, bundle.task.horizons, bundle.predictor.output.coverages
    if not (isinstance(rate, int | float) and math.isfinite(rate) and 1e-6 <= rate <= 1e6):
        raise ExportError(f"the rate of the network is {rate!r} Hz; it must be a number from 1e-6 to 1e6: train again")
    # Horizon 0 is the present; it is exported like the others.
    if not all(isinstance(k, int) and 0 <= k <= LARGEST for k in horizons):
        raise ExportError(f"a horizon of the network is {max(horizons)!r} ticks; at most {LARGEST:,} can be exported")
    if not all(isinstance(share, float) and 0.0 < share < 1.0 for share in coverages):
        raise ExportError(f"intervals of the network cover {list(coverages)}; shares between 0 and 1 can be exported")


def check_sizes(sizes: Mapping[str, int], limit: int = LARGEST) -> None:
    """Refuse sizes beyond the index range of the generated code.

    Args:
        sizes: sizes by their description.
        limit: the largest one.

    Raises:
        ExportError: one is larger; it is named.
    """
    for what, size in sizes.items():
        if size > limit:
            raise ExportError(
                f"{what}: {size:,}; the generated code counts up to {limit:,}. Train a network with fewer units, "
                "inputs or a shorter window"
            )
