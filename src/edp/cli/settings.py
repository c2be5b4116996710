"""Settings of commands on the command line: their file, single changes, and options that became settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SettingsOption = Annotated[
    Path | None,
    typer.Option("--config", help="Settings (TOML): the table of this command, and tables of its trainings."),
]

_SAME = {
    "finetune": "head_epochs epochs head_rate backbone_rate depth_decay rounds rate batch smoothness weight_decay "
    "patience rank source_weight soft reversal inner_rate inner_steps center",
    "adapt": "rank noise prior limit margin",
    "distil": "levels",
    "compress": "units",
    "pretrain": "inner_rate inner_steps shots",
    "screen": "trusted",
}
FORMER = {(command, name): f"{command}.{name}=VALUE" for command, names in _SAME.items() for name in names.split()} | {
    ("finetune", "no_center"): "finetune.center=false",
    ("finetune", "any_sign"): "finetune.check_signs=false",
    ("adapt", "rest"): "adapt.dead_zone=VALUE",
    ("adapt", "forgetting"): "adapt.forgetting_s=VALUE",
    ("adapt", "judged"): "adapt.judged_s=VALUE",
    ("distil", "pruned"): "distil.pruned=true",
    ("distil", "truth"): "distil.objective.truth=VALUE",
    ("distil", "hint"): "distil.objective.hint=VALUE",
    ("compress", "format"): "compress.formats=[VALUE]",
    ("compress", "thesis"): "compress.thesis=true",
    ("compress", "units"): "compress.units=[VALUE]",
    ("pretrain", "head_only"): "pretrain.head_only=true",
    ("screen", "trusted"): "screen.trusted=[VALUE]",
    ("screen", "random"): "trials.random=VALUE",
    ("run", "mode"): "search.mode=VALUE",
    ("simulate", "masses"): "masses=[LOW, HIGH]",
    ("simulate", "scatter"): "scatter=VALUE",
    ("simulate", "layout"): "files.layout=VALUE",
    ("simulate", "truth"): "files.truth=VALUE",
    ("simulate", "moments"): "limit.moments=VALUE",
    ("simulate", "branches"): "limit.branches=VALUE",
    ("simulate", "horizons"): "limit.horizons=[VALUE]",
}
"""By command and option up to version 0.1, what stands behind ``--set`` for it now."""


def setting_of(command: str, option: str) -> str | None:
    """The ``--set`` form of an option that is a setting now; None for any other word."""
    setting = FORMER.get((command, option.lstrip("-").replace("-", "_")))
    return None if setting is None else f"--set '{setting}'"
