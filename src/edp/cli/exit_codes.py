"""Exit codes of all commands, from which the reference of commands is made."""

from __future__ import annotations

from collections.abc import Mapping

EXIT_CODES: Mapping[str, str] = {
    "0": "The command is done.",
    "1": "A mistake, with one message; of `edp verify` also an exported format that differs from PyTorch.",
    "2": "An unknown word or option of the command line.",
    "3": "`edp data check`, `edp data store build`: a log has an error that training would refuse, or cannot be read. "
    "`edp doctor`: the installation does not work.",
    "4": "A training diverged; the best weights before that are saved.",
    "5": "`edp monitor run`: there is an alarm.",
    "6": "The reference has less error than the model on the held-out recordings.",
    "75": "Another process uses the folder, or a worker was lost repeatedly; try again later.",
    "130": "Stopped by Ctrl-C; the same command continues.",
    "141": "Nobody reads the output any more, such as after `| head`.",
    "143": "Stopped by a request to end (SIGTERM); the same command continues.",
}
"""Meaning of each exit code."""
EXIT_CODES_AT = "Exit codes: 0 done, 1 a mistake; all of them: docs/commands.md, section Exit codes."
