"""The ledger of trainings: one checksummed record a training, found by the content of what decides its result.

A training is never done twice, whatever is killed: a record is whole or absent, damaged ones are set apart and trained
again, and a search that starts again reads here what was done.
"""

from edp.storage.ledger.claims import Claim, claim, known, leave_arrival
from edp.storage.ledger.record import (
    FINAL,
    Record,
    TrainingIdentity,
    TrainingStatus,
    canonical,
    code_version,
    digest_of,
)
from edp.storage.ledger.states import WithState, leave_state, read_state, state_path
from edp.storage.ledger.store import Damage, Ledger, Opening, check_uncoordinated, read_records

__all__ = [
    "FINAL",
    "Claim",
    "Damage",
    "Ledger",
    "Opening",
    "Record",
    "TrainingIdentity",
    "TrainingStatus",
    "WithState",
    "canonical",
    "check_uncoordinated",
    "claim",
    "code_version",
    "digest_of",
    "known",
    "leave_arrival",
    "leave_state",
    "read_records",
    "read_state",
    "state_path",
]
