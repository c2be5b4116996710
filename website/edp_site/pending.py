"""New names of commands and options, translated to those of the present command line; deleted with the renaming.

Pages use the new names. Until the command line has them, the checks of pages translate each line with `as_today`.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

_COMMANDS = {
    "data check": "inspect",
    "data screen": "screen",
    "data animate": "animate",
    "data add-forecasts": "forecast",
    "data store build": "store build",
    "data store verify": "store check",
    "train finetune": "finetune",
    "train pretrain": "pretrain",
    "compress distil": "distil",
    "compress quantise": "quantise",
    "compress search": "compress",
    "compress estimate": "footprint",
    "verify": "parity",
    "adapt replay": "replay",
    "calibrate": "identify",
    "loop run": "control",
    "loop tune": "tune",
}
"""New words of a command to the present ones."""
_OPTIONS = {
    "train": {"--time-budget": "--minutes"},
    "twin": {"--time-budget": "--minutes"},
    "monitor fit": {"--time-budget": "--minutes"},
    "simulate": {"--duration": "--minutes"},
    "rollout": {"--rollout-seconds": "--seconds"},
    "export": {"--format": "--to", "--formats": "--forms"},
    "parity": {"--format": "--form"},
    "search": {"--out": "--study"},
    "inspect": {"--max-hours": "--at-most"},
    "screen": {"--max-hours": "--at-most"},
    "evaluate": {"--max-hours": "--at-most"},
    "forecast": {"--horizon": "--ahead"},
    "control": {"--loops": "--seeds"},
    "tune": {"--tuning-plant": "--on"},
}
"""New names of options to the present ones, by present command; their values are times with a unit or plain words."""
_SETTINGS = {
    "evaluation.duration_s": "judge.seconds",
    "evaluation.warmup_samples": "judge.skip",
    "evaluation.": "judge.",
    "trials.random_sets": "trials.random",
    "screen.measured": "screen.trusted",
    "auto.time_budget_min": "auto.minutes",
    "finetune.learning_rate": "finetune.rate",
}
"""New keys of settings to the present ones."""
_MINUTES = {"s": 1 / 60, "min": 1.0, "h": 60.0}


def as_today(line: str) -> str:
    """Return a command line of a page with the present names; a line with present names is returned unchanged."""
    if not line.startswith("edp "):
        return line
    head, mark, remark = line.partition("  #")
    words = head.split(" ")[1:]
    for count in (3, 2, 1):
        if " ".join(words[:count]) in _COMMANDS:
            words = [*_COMMANDS[" ".join(words[:count])].split(), *words[count:]]
            break
    text = f"edp {' '.join(words)}"
    if re.match(r"edp train .*--focus simulation", text):
        text = re.sub(r" --focus simulation", "", text.replace("edp train", "edp twin", 1))
    for command, names in _OPTIONS.items():
        if text.startswith(f"edp {command} ") and not re.match(r"edp search (status|report|export) ", text):
            for new, old in names.items():
                text = re.sub(rf"(?<= ){new}(?![\w-])", old, text)
            text = re.sub(r"(--minutes )([\d.]+)(s|min|h)\b", _in_minutes, text)
    for new, old in _SETTINGS.items():
        text = text.replace(f"--set {new}", f"--set {old}").replace(f"--set '{new}", f"--set '{old}")
    return text + mark + remark


def code_as_today(source: str) -> str:
    """Return Python code with the present keys of settings in its strings."""
    for new, old in _SETTINGS.items():
        source = source.replace(f'"{new}', f'"{old}')
    return source


def _in_minutes(match: re.Match[str]) -> str:
    return f"{match[1]}{float(match[2]) * _MINUTES[match[3]]:g}"


MOVED_PAGES = {
    "tutorial.md": "tutorials/csv_to_c.ipynb",
    "own_logs.md": "howto/map_columns.md",
    "howto.md": "howto/index.md",
    "howto_plant.md": "howto/train_plant_model.md",
    "howto_second_machine.md": "howto/second_machine.md",
    "howto_small_controller.md": "howto/fit_budget.md",
    "howto_watch.md": "howto/watch_machine.md",
    "faq.md": "howto/troubleshooting.md",
    "install.md": "howto/install.md",
    "recordings.md": "howto/repair_logs.md",
    "store.md": "howto/large_stores.md",
    "channels.md": "reference/channels.md",
    "screening.md": "howto/choose_channels.md",
    "compare.md": "howto/compare_runs.md",
    "compress.md": "howto/fit_budget.md",
    "export.md": "howto/deploy_c.md",
    "onnx.md": "howto/deploy_onnx.md",
    "fmu.md": "howto/deploy_fmu.md",
    "simulink.md": "howto/deploy_simulink.md",
    "ros2.md": "howto/deploy_ros2.md",
    "mpc.md": "howto/mpc.md",
    "environment.md": "howto/reinforcement_learning.md",
    "live.md": "howto/live_view.md",
    "fleet.md": "howto/fleet.md",
    "finetune.md": "howto/second_machine.md",
    "foundation.md": "howto/fleet.md",
    "adaptation.md": "howto/adapt_on_board.md",
    "faults.md": "howto/inject_faults.md",
    "control.md": "howto/close_the_loop.md",
    "search.md": "howto/run_search.md",
    "simulator.md": "explanation/simulator.md",
    "auto.md": "explanation/automatic_choice.md",
    "monitor.md": "explanation/monitor.md",
    "twin.md": "howto/train_plant_model.md",
}
"""Deleted pages of docs/ to the pages that took their place; `relink` rewrites the links of all pages at the merge."""


def is_pending(problem: str) -> bool:
    """Return whether a broken link leads to a page of docs/ that another page replaced."""
    return problem.split(": ")[1].partition("#")[0].rpartition("/")[2] in MOVED_PAGES


def relink(root: Path) -> None:
    """Rewrite links to deleted pages in all pages of the repository."""
    for page in [*root.glob("*.md"), *root.glob("docs/**/*.md"), *root.glob("website/pages/*.md")]:
        text = page.read_text(encoding="utf-8")
        base = root / "docs" if page.is_relative_to(root / "website") else page.parent

        def moved(match: re.Match[str], base: Path = base) -> str:
            place = (base / match[1]).resolve()
            name = MOVED_PAGES.get(place.name) if place.parent == (root / "docs").resolve() else None
            if name is None or place.exists():
                return match[0]
            return f"]({os.path.relpath(root / 'docs' / name, base)})"

        found = re.sub(r"\]\(([\w./-]+\.md)(?:#[\w-]*)?\)", moved, text)
        if found != text:
            page.write_text(found, encoding="utf-8")


if __name__ == "__main__":
    relink(Path(__file__).parents[2])
