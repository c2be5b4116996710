"""One rule for headline, first line and exit code: stated in docs/commands.md and in `edp.evaluation.guard`."""

import ast
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from sample_scores import sample_errors, sample_free_run_scores
from typer.main import get_command

from edp.cli import app, console
from edp.cli.exit_codes import EXIT_CODES
from edp.cli.verdicts import end_with, show_verdict, verdict_facts
from edp.evaluation.guard import (
    BEATEN,
    MACHINE,
    ErrorOutcome,
    ErrorVerdict,
    adaptation_verdict,
    by_recording,
    machine_verdict,
    network_verdict,
    outcome_of,
    tuning_verdict,
    twin_verdict,
)
from edp.evaluation.scores_file import ModelScores, ScoredTarget, ScoredTask, ScoresFile
from edp.evaluation.tuning_file import ErrorChange, TipErrors
from edp.report.transfer.facts import transfer_verdict

ROOT = Path(__file__).parents[3]
COMMANDS = ROOT / "src/edp/cli"
JUDGING = {"evaluate", "twin", "calibrate", "train finetune", "adapt run", "adapt replay", "loop tune"}
"""Commands that end with a verdict."""
EARLIER = {"identify", "finetune", "adapt", "replay", "tune"}
"""Names of judging commands that pages written for earlier versions use."""
HEADLINE = {"search run", "search report", "compare"}
"""Commands that take the outcome's words for a page and end with 0: they compare several, none of which is judged."""
EVALUATED_LATER = {"train run", "compress distil", "compress search", "compress quantise", "train pretrain"}
"""Commands that make a network, state its validation error or its cost, and leave the verdict to `edp evaluate`."""
NO_COMPARISON = {
    *("demo", "simulate", "init", "data check", "data screen", "data animate", "rollout", "data add-forecasts"),
    *("loop run", "live", "compress estimate", "export", "verify", "report", "runs", "doctor", "data store build"),
    *("data store verify", "search status"),
    *("search export", "fleet report", "fleet network", "registry add", "registry list", "registry show"),
    *("monitor fit", "monitor run", "monitor report"),
}
"""Commands that hold no model against a reference by its error on recordings."""


def commands(group, words=()):
    """Each command of the tree by its words."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*words, name))
        else:
            yield " ".join((*words, name)), command


TREE = dict(commands(get_command(app)))
FILES = {TREE[name].callback.__module__.rsplit(".", 1)[1] for name in JUDGING}


def test_every_command_of_the_tree_is_declared_once():
    declared = [*JUDGING, *HEADLINE, *EVALUATED_LATER, *NO_COMPARISON]
    assert sorted(declared) == sorted(TREE)


def free_runs(ratios, judged):
    """Scores of free runs with error 1 of what is judged in each recording, and `ratios` of one floor."""

    def summary(error):
        return sample_errors(error, error, error, times=(1.0, 10.0))

    def scored(errors):
        by_recording = {f"r{i}": summary(error) for i, error in enumerate(errors)}
        return sample_free_run_scores(summary(sum(errors) / len(errors)), by_recording)

    return {judged: scored([1.0] * len(ratios)), "Static map": scored(ratios)}


def adapted(*ratios):
    """Replayed recordings whose error with adaptation is 1, and `ratios` without."""
    changes = {f"r{i}": 1.0 / ratio - 1.0 for i, ratio in enumerate(ratios)}
    return SimpleNamespace(change=sum(changes.values()) / len(changes), change_by_recording=changes)


class Methods:
    """Scores of a fine-tuned network with error 1 beside one other method."""

    horizons, content = (1,), SimpleNamespace(method="tuned")

    def __init__(self, ratios):
        self.ratios = ratios
        self.methods = {"tuned": SimpleNamespace(label="Tuned"), "direct": SimpleNamespace(label="Direct")}

    def mae(self, name, horizon):
        return 1.0 if name == "tuned" else sum(self.ratios) / len(self.ratios)

    def recordings(self, name, horizon):
        return {f"r{i}": 1.0 if name == "tuned" else ratio for i, ratio in enumerate(self.ratios)}


def tuned(*ratios):
    """Position errors of 1 after tuning on each reference, and `ratios` before."""
    by_reference = {f"grade {i}": ErrorChange(before=ratio, after=1.0) for i, ratio in enumerate(ratios)}
    return TipErrors(before=sum(ratios) / len(ratios), after=1.0, by_reference=by_reference)


VERDICTS = {
    "evaluate": lambda *ratios: network_verdict(scores(*ratios)),
    "twin": lambda *ratios: twin_verdict(free_runs(ratios, "twin")),
    "calibrate": lambda *ratios: machine_verdict(free_runs(ratios, MACHINE)),
    "train finetune": lambda *ratios: transfer_verdict(Methods(ratios)),
    "adapt run": lambda *ratios: adaptation_verdict(adapted(*ratios)),
    "adapt replay": lambda *ratios: adaptation_verdict(adapted(*ratios)),
    "loop tune": lambda *ratios: tuning_verdict(tuned(*ratios)),
}
UNITS = dict.fromkeys(JUDGING, "recordings") | {"loop tune": "references"}
"""What the interval of each command is over."""
CASES = {
    ErrorOutcome.WORSE: (0.5, 0.6, 0.7, 0.55),
    ErrorOutcome.BETTER: (1.5, 1.6, 1.7, 1.55),
    ErrorOutcome.OPEN: (1.9, 0.6, 3.0, 0.7),
}


def test_every_judging_command_has_a_verdict_function_here():
    assert set(VERDICTS) == JUDGING


@pytest.mark.parametrize("command", sorted(JUDGING))
@pytest.mark.parametrize("outcome", list(ErrorOutcome))
def test_exit_code_first_line_and_headline_agree(command, outcome, capsys):
    verdict = VERDICTS[command](*CASES[outcome])
    assert verdict.outcome is outcome
    assert ("do not use" in verdict.sentence()) or f"over 4 {UNITS[command]}: " in verdict.sentence()
    show_verdict(verdict)
    first = " ".join(capsys.readouterr().out.split())
    assert first == verdict.sentence()
    page = verdict.headline("Figures.")
    assert page.startswith(first)
    worse = outcome is ErrorOutcome.WORSE
    assert ("do not use" in first) is ("Figures." not in page) is (verdict_facts(verdict)["beaten_by"] is not None)
    assert ("do not use" in first) is worse
    if worse:
        with pytest.raises(typer.Exit) as ended:
            end_with(verdict)
        assert ended.value.exit_code == BEATEN == verdict.exit_code
    else:
        end_with(verdict)
        assert verdict.exit_code == 0


@pytest.mark.parametrize("command", sorted(JUDGING))
def test_equal_errors_are_not_distinguishable(command):
    verdict = VERDICTS[command](1.0, 1.0, 1.0, 1.0)
    assert verdict.outcome is ErrorOutcome.OPEN
    assert "0.0 % less error (95 % interval of the change over 4" in verdict.sentence()
    # Rounding and threads make differences of this size.
    assert VERDICTS[command](*[1.0 + 1e-6] * 4).outcome is ErrorOutcome.OPEN


@pytest.mark.parametrize("command", sorted(JUDGING))
def test_too_few_units_are_named(command):
    verdict = VERDICTS[command](1.5, 1.6)
    assert verdict.outcome is ErrorOutcome.OPEN
    assert f"2 {UNITS[command]} are too few for an interval: chance is not excluded" in verdict.sentence()


def test_stretches_of_one_recording_are_one_unit():
    logs = {"a[0:10]": [0.2], "a[20:30]": [0.4], "b": [1.0, math.nan], "c": [math.nan]}
    assert by_recording(logs) == pytest.approx({"a": 0.3, "b": 1.0})


def test_scores_of_earlier_versions_without_recordings_have_no_interval():
    old = {name: replace(one, by_recording={}) for name, one in free_runs((1.5, 1.6, 1.7), "twin").items()}
    assert "no interval: chance is not excluded" in twin_verdict(old).sentence()
    assert "no interval" in tuning_verdict(TipErrors(before=2.0, after=1.0)).sentence()


def test_pages_take_their_headline_from_the_verdict():
    """A page that calls a verdict function makes its headline by `ErrorVerdict.headline`."""
    users = {
        file
        for file in (ROOT / "src/edp/report").rglob("*.py")
        if re.search(r"\b(network|twin|transfer|machine|adaptation|tuning)_verdict\(", file.read_text(encoding="utf-8"))
    }
    assert len(users) >= 3
    for file in users:
        text = file.read_text(encoding="utf-8")
        assert "judged.headline(figures)" in text, file
        assert "judged.sentence()" not in text, file


def test_the_docs_name_the_commands_that_judge_and_those_that_do_not():
    page = (ROOT / "docs/commands.md").read_text(encoding="utf-8").split("## Verdicts")[1]
    rows = page.split("| Command | Compares | With |")[1].split("\n\n")[0]
    named = set(re.findall(r"`edp ([a-z ]+)`", rows))
    assert named == {name.removesuffix(" run") for name in (JUDGING | HEADLINE) - {"search report"}}
    sentence = page.split("compare nothing")[0].split("\n")[-1]
    assert set(re.findall(r"`edp ([a-z ]+)`", sentence)) == {name.removesuffix(" run") for name in EVALUATED_LATER}


def scores(*ratios, horizons=(1,)):
    """Scores of a network with error 1 in each recording, and of one baseline with errors `ratios`."""

    def model(label, errors):
        entry = {str(k): {"v": {"rmse": sum(errors) / len(errors)}} for k in horizons}
        by = {f"r{i}": {str(k): {"v": {"rmse": e}} for k in horizons} for i, e in enumerate(errors)}
        return ModelScores(label=label, overall=entry, recordings=by)

    models = {"network": model("Network", [1.0] * len(ratios)), "ridge": model("Ridge", list(ratios))}
    return ScoresFile(task=ScoredTask(horizons=horizons), targets=(ScoredTarget(name="v"),), models=models)


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
    assert outcome_of(-1e-6, -1e-7) is ErrorOutcome.OPEN
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
    assert ends == FILES


def test_a_command_whose_help_or_module_compares_with_a_reference_is_one_that_judges():
    """A new use of the verdict's functions outside of the listed files fails here."""
    users = {
        file.stem
        for file in COMMANDS.glob("*.py")
        if re.search(r"_verdict\b|beaten_by\(", file.read_text(encoding="utf-8")) and file.name != "verdicts.py"
    } - {"data check", "quality"}
    assert users == FILES


def test_exit_codes_of_the_table_are_those_of_the_code():
    stated = set(map(int, EXIT_CODES))
    named = {0, 1, 2, BEATEN, 4, 75, console.INTERRUPTED, console.CLOSED_PIPE, 128 + 15}
    for file in COMMANDS.glob("*.py"):
        codes = re.findall(r"^(?:FAULTY|ALARMS|BROKEN) = (\d+)", file.read_text(encoding="utf-8"), re.MULTILINE)
        named |= set(map(int, codes))
    assert stated == named


def test_pages_promise_the_exit_code_for_commands_that_judge():
    """Every paragraph of the docs with exit code 6 names a command that ends by the rule."""
    promised = []
    for file in sorted(page for page in (ROOT / "docs").rglob("*.md") if page.parent.name != "decisions"):
        for text in re.split(r"\n\s*\n", file.read_text(encoding="utf-8")):
            if re.search(r"(?i)exit\s+code\s+6", text):
                named = set(re.findall(r"`edp ((?:train |adapt |loop )?[a-z]+)", text))
                promised.append(file.name)
                assert not named or named & {*JUDGING, *EARLIER}, (file.name, text)
    assert {"troubleshooting.md", "train_plant_model.md", "close_the_loop.md", "adapt_on_board.md"} <= set(promised)
    evaluate = TREE["evaluate"].callback.__doc__
    assert f"exit code {BEATEN}" in evaluate
