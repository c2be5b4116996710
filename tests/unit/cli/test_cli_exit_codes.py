"""One rule for headline, first line and exit code: stated in docs/commands.md and in `edp.evaluation.guard`."""

import ast
import re
from pathlib import Path

import pytest
from typer.main import get_command

from edp.cli import app, console, verdicts
from edp.evaluation.guard import BEATEN, ErrorOutcome, ErrorVerdict, network_verdict, outcome_of

ROOT = Path(__file__).parents[3]
COMMANDS = ROOT / "src/edp/cli"
JUDGING = {"evaluate", "twin", "identify", "finetune"}
"""Files of commands that end with a verdict."""


def scores(*ratios, horizons=(1,)):
    """Scores of a network with error 1 in each recording, and of one baseline with errors `ratios`."""

    def model(label, errors):
        entry = {str(k): {"v": {"rmse": sum(errors) / len(errors)}} for k in horizons}
        by = {f"r{i}": {str(k): {"v": {"rmse": e}} for k in horizons} for i, e in enumerate(errors)}
        return {"label": label, "overall": entry, "recordings": by}

    models = {"network": model("Network", [1.0] * len(ratios)), "ridge": model("Ridge", list(ratios))}
    return {"models": models, "targets": [{"name": "v"}], "task": {"horizons": list(horizons)}}


@pytest.mark.parametrize(
    ("ratios", "outcome", "words"),
    [
        ((0.5, 0.6, 0.7), ErrorOutcome.WORSE, "do not use this network"),
        ((0.99,), ErrorOutcome.WORSE, "do not use this network"),
        ((1.5, 1.6, 1.7, 1.55), ErrorOutcome.BETTER, "less error than Ridge, the best of the others (95 % interval"),
        ((0.4, 1.4, 3.0), ErrorOutcome.OPEN, "is not distinguishable from Ridge"),
        ((2.0,), ErrorOutcome.OPEN, "1 recording is too few for an interval: chance is not excluded"),
        ((1.0, 1.0), ErrorOutcome.OPEN, "chance is not excluded"),
    ],
)
def test_sentence_and_exit_code_follow_the_outcome(ratios, outcome, words):
    verdict = network_verdict(scores(*ratios))
    assert verdict.outcome is outcome
    assert words in verdict.sentence()
    assert verdict.exit_code == (BEATEN if outcome is ErrorOutcome.WORSE else 0)
    assert ("do not use" in verdict.sentence()) == bool(verdict.exit_code)


def test_better_needs_an_interval_that_excludes_zero():
    assert outcome_of(-0.38, 1.14) is ErrorOutcome.OPEN
    assert outcome_of(-0.38, None) is ErrorOutcome.OPEN
    assert outcome_of(-0.38, -0.01) is ErrorOutcome.BETTER
    assert outcome_of(0.02, 0.5) is ErrorOutcome.WORSE
    assert ErrorVerdict("x", 1.0, ()).outcome is ErrorOutcome.WORSE


def constants(tree):
    """Names of exit codes that a module of the command line raises."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    exits = [call for call in calls if isinstance(call.func, ast.Attribute) and call.func.attr == "Exit" and call.args]
    return {ast.unparse(call.args[0]) for call in exits}


def test_every_command_file_ends_by_the_rule():
    """No file of a command raises `BEATEN` by itself, and those that judge end with `end_with`."""
    ends = set()
    for file in sorted(COMMANDS.glob("*.py")):
        text = file.read_text(encoding="utf-8")
        if file.name != "verdicts.py":
            assert not constants(ast.parse(text)) & {"BEATEN", "6", "verdict.exit_code"}, file.name
        if "end_with(" in text and file.name != "verdicts.py":
            ends.add(file.stem)
            assert text.count("end_with(verdict)") == text.count("show_verdict(verdict)"), file.name
            assert text.count("end_with(verdict)") == text.count("verdict_facts(verdict)"), file.name
    assert ends == JUDGING
    assert callable(verdicts.end_with)


def test_a_command_whose_help_or_module_compares_with_a_reference_is_one_that_judges():
    """A new use of the verdict's functions outside of the listed files fails here."""
    users = {
        file.stem
        for file in COMMANDS.glob("*.py")
        if re.search(r"_verdict\b|beaten_by\(", file.read_text(encoding="utf-8")) and file.name != "verdicts.py"
    } - {"inspect", "quality"}
    assert users == JUDGING
    assert set(get_command(app).commands) >= JUDGING


def test_exit_codes_of_the_docs_are_those_of_the_code():
    page = (ROOT / "docs/commands.md").read_text(encoding="utf-8")
    table = page.split("| Exit code | Means |")[1].split("\n\n")[0]
    first = [row.split("|")[1] for row in table.splitlines() if row.startswith("| ")]
    stated = {int(code) for cell in first for code in re.findall(r"\d+", cell)}
    named = {0, 1, 2, BEATEN, 4, 75, console.INTERRUPTED, 128 + 15}
    for file in COMMANDS.glob("*.py"):
        codes = re.findall(r"^(?:FAULTY|ALARMS|BROKEN) = (\d+)", file.read_text(encoding="utf-8"), re.MULTILINE)
        named |= set(map(int, codes))
    assert stated == named
