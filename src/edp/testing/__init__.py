"""Contracts of EDP's parts as functions that third parties can call on their own parts.

``check_block(MyBlock)`` and its like raise `ContractError`, an `AssertionError`, with what is wrong; they need no test
runner. A part is registered first, as docs/reference/parts.md tells. EDP's own tests call the same functions.
"""

from edp.testing.expectations import ContractError
from edp.testing.logs import check_log_format
from edp.testing.losses import check_loss
from edp.testing.networks import check_block, check_spec
from edp.testing.streaming import check_network
from edp.testing.targets import check_export_target
from edp.testing.twins import check_twin

__all__ = [
    "ContractError",
    "check_block",
    "check_export_target",
    "check_log_format",
    "check_loss",
    "check_network",
    "check_spec",
    "check_twin",
]
