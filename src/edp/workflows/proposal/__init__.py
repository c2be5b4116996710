"""From a folder of unknown logs to a signal map and settings with which the other commands run."""

from edp.workflows.proposal.propose import LogsProposal, propose, write_proposal

__all__ = ["LogsProposal", "propose", "write_proposal"]
