"""Sentences on a study: result, effort, and limits of its evidence."""

from __future__ import annotations

import re
from collections.abc import Sequence

from edp.errors import count_of
from edp.evaluation.guard import ErrorOutcome, outcome_of
from edp.evaluation.study import NUMBERS, StudyFile
from edp.evaluation.study_facts import (
    CalibrationFacts,
    ConfirmationFacts,
    ExplorationFacts,
    IsolationFacts,
    ScreeningFacts,
    SoundPlanning,
    SynthesisFacts,
    ThesisPlanning,
)
from edp.report.search.facts import require_phase
from edp.report.search.smaller import describe_choice
from edp.report.search.views import titled
from edp.wording import behind, count_text, duration, listed, number, percent, setting_text


def headline(study: StudyFile) -> str:
    """Return the result of a study in one sentence, or its progress."""
    if "synthesis" in study.decided:
        return _result(study)
    decided = sum(phase.name in study.decided for phase in study.all_phases)
    how = {"running": "is running", "finished": "ended early"}.get(study.state, f"was {study.state}")
    done = count_of(len(study.ended), "training")
    return f"The search {how}: {decided} of {len(study.all_phases)} phases are decided, {done} done."


@require_phase(SynthesisFacts, "")
def _result(study: StudyFile, facts: SynthesisFacts) -> str:
    ours, base = (facts.test[arm]["composite"] for arm in ("synthesis", "baseline"))
    own = [study.module(name) for name in facts.modules]
    names = listed(own) if len(own) <= 3 else f"{len(own)} modules"
    if ours is None or base is None:
        return "A final training failed, so that nothing can be said of the test sessions."
    sessions = count_of(len(study.sessions.test), "test session")
    gain = facts.test_gain
    outcome = outcome_of(ours / base - 1, None if gain is None else gain.high)
    what = f"With {names}" if own else "Tuned anew, with no module,"
    figures = f"{number(ours, 3)}{behind(study.unit)} on {sessions}"
    if outcome is ErrorOutcome.BETTER:
        change = percent(1 - ours / base)
        return f"{what} the network reaches {figures}, {change} below the baseline's {number(base, 3)}."
    if outcome is ErrorOutcome.OPEN:
        return f"{what} the network is not distinguishable from the baseline: {figures}, against {number(base, 3)}."
    return (
        f"Nothing better than the baseline was found: {number(base, 3)}{behind(study.unit)} on {sessions}, against "
        f"{number(ours, 3)} with {names or 'no module'}."
    )


def verdict(study: StudyFile) -> list[str]:
    """Return the decisions in short sentences."""
    lines = [
        _how_sure(study),
        _features(study),
        _baseline(study),
        _describe_confirmed(study),
        _teacher(study),
        describe_choice(study),
    ]
    if study.state != "finished":
        where = next((phase for phase in study.all_phases if phase.name not in study.decided), None)
        lines.append(f"The search {'is' if study.state == 'running' else 'was'} {study.state}")
        lines[-1] += f" in {where.heading.lower()}" if where else ""
        lines[-1] += "." if study.state == "running" else "; the same command goes on with it."
    return [line for line in lines if line]


@require_phase(SynthesisFacts, "")
def _how_sure(study: StudyFile, facts: SynthesisFacts) -> str:
    gain = facts.test_gain
    if gain is None:
        return "With one seed or one test session there is no interval for that."
    low, high = (percent(end, signed=True) for end in (gain.low, gain.high))
    unsure = "" if gain.high < 0 or gain.low > 0 else ", so chance alone may have done it"
    return f"The 95 % interval of the change is {low} to {high}{unsure}."


@require_phase(IsolationFacts, "")
def _features(study: StudyFile, facts: IsolationFacts) -> str:
    if len(facts.mean_scores) < 2:
        return ""
    sure = all(comparison.p < float(study.spec["alpha"]) for comparison in facts.comparisons.values())
    return f"Feature set {facts.features} goes on" + (
        ", better with every backbone." if sure else ", though not every backbone shows that it is better."
    )


@require_phase(CalibrationFacts, "")
def _baseline(study: StudyFile, facts: CalibrationFacts) -> str:
    parameters = facts.backbones[facts.backbone].costs["parameters"]
    return f"The baseline is {titled(facts.backbone)} with {count_text(parameters)} parameters."


@require_phase(ConfirmationFacts, "")
def _describe_confirmed(study: StudyFile, facts: ConfirmationFacts) -> str:
    names = [study.module(name) for name in facts.confirmed]
    registered = len(_list_registered(study))
    if not names:
        return f"None of {registered} modules is confirmed."
    which = f": {listed(names)}" if len(names) <= 6 else ""
    return f"{len(names)} of {registered} modules {'is' if len(names) == 1 else 'are'} confirmed{which}."


@require_phase(ScreeningFacts, ())
def _list_registered(study: StudyFile, facts: ScreeningFacts) -> tuple[str, ...]:
    return facts.registered


@require_phase(ExplorationFacts, "")
def _teacher(study: StudyFile, facts: ExplorationFacts) -> str:
    change = percent(facts.change, signed=True)
    if facts.teacher == "exploration":
        return f"The free search of phase 5 found a better one still ({change} on fresh folds)."
    return f"The free search of phase 5 found nothing that fresh folds bear out ({change})."


def tiles(study: StudyFile) -> list[tuple[str, str, str]]:
    """Return the key figures: value, unit, what."""
    pruned = sum(training.status == "pruned" for training in study.ended)
    failed = sum(training.status not in ("done", "pruned") for training in study.ended)
    trained = sum(phase.seconds for phase in study.phases)
    exceptions = [f"{count} of them {what}" for count, what in ((pruned, "pruned"), (failed, "failed")) if count]
    tiles = [(count_text(len(study.ended)), "", ", ".join(["trainings", *exceptions]))]
    if trained:
        clock = duration(sum(phase.wall_s for phase in study.phases))
        value, _, unit = duration(trained).partition(" ")
        tiles.append((value, unit, f"of training, {clock} by the clock"))
    confirmation = study.facts(ConfirmationFacts)
    if confirmation is not None:
        confirmed = count_text(len(confirmation.confirmed))
        tiles.append((confirmed, "", f"of {len(_list_registered(study))} modules confirmed"))
    openings = len(study.openings)
    sealed = count_of(len(study.sessions.test) + len(study.sessions.second), "session")
    tiles.append((count_text(openings), "", f"opening{'s' * (openings != 1)} of {sealed} set apart"))
    return tiles


def caveats(study: StudyFile) -> list[str]:
    """Return the limits of the evidence that these trainings give, from the settings of the study."""
    spec, sessions = study.spec, study.sessions
    updates, final = int(spec["updates"]), int(spec["final_updates"])
    horizon = count_of(int(spec["horizon"]), "sample")
    caveats = [
        f"Every comparison is between trainings of {_length(study, updates)}, judged {horizon} ahead. It shows which "
        "part learns more from so little: a part that pays only after long training is missed, and one that only "
        "speeds up the start is favoured.",
        f"Only the last trainings are longer ({_length(study, final)}); they judge the whole network, not its single "
        "modules."
        if final > updates
        else f"The last trainings are no longer ({_length(study, final)}), so nothing is known of long ones.",
        f"Sessions: {len(sessions.development)} that train and judge in turn, {len(sessions.test)} set apart"
        + (f", {len(sessions.second)} more for phase 6" if sessions.second else "")
        + ". Intervals and p-values speak of sessions like these, not of another machine.",
        *(_sound_power if study.mode == "sound" else _thesis_power)(study),
        "Modules are tried on one baseline with one feature set; on another network they may do otherwise.",
        f"Winners were tuned further than the baseline ({count_of(int(spec['joint_trials']), 'more question')} in "
        f"phase 4, {count_text(int(spec['free_trials']))} in phase 5), so part of their gain may be "
        "tuning and not modules.",
        "The best of many questions is the best partly by chance, so scores of winners on development sessions are too "
        "good. Only test sessions and fresh folds count.",
    ]
    if study.mode == "thesis":
        caveats.append(
            "This study follows the thesis's tests, to be compared with it. They take splits that share "
            "most of their training data as independent, and accept a module on any of four metrics, so they confirm "
            "useless modules more often than their level says; conclusions want the sound mode."
        )
    return caveats


def _length(study: StudyFile, updates: int) -> str:
    """Return the length of a training in words."""
    epochs = int(study.spec.get("epochs", 1))
    if epochs == 1:
        return f"{count_text(updates)} updates"
    each = f"{count_text(updates // epochs)} updates" if updates else "one pass over the data"
    return f"at most {epochs} epochs of {each}"


@require_phase(SoundPlanning, ())
def _sound_power(study: StudyFile, facts: SoundPlanning) -> tuple[str, ...]:
    effect = percent(float(study.spec["least_effect"]))
    text = (
        f"{count_of(facts.runs, 'run')} of each arm were planned to show an effect of {effect}, which they do with a "
        "probability of "
        f"{number(facts.power, 2)}: a module that is not confirmed is not shown to be useless."
    )
    if facts.enough is None:
        text += f" No number of runs on these sessions could make that more than {number(facts.limit, 2)}."
    return (text,)


@require_phase(ThesisPlanning, ())
def _thesis_power(study: StudyFile, facts: ThesisPlanning) -> tuple[str, ...]:
    effect = percent(float(study.spec["least_effect"]))
    return (
        f"{facts.runs} splits were planned to show an effect of {effect} by a formula that counts the spread "
        "of seeds only; the spread between splits and sessions makes that too few.",
    )


def decided(study: StudyFile) -> list[tuple[str, tuple[str, ...]]]:
    """Return each phase with its decision and reason, or its progress."""
    decisions, sentences = [], {decision.phase: decision.sentences for decision in study.decisions}
    for phase in study.all_phases:
        lines = sentences.get(phase.name)
        if lines is None:
            count = sum(training.phase == phase.name for training in study.ended)
            lines = (f"Under way: {count_of(count, 'training')} done." if phase.began else "Has not begun.",)
        decisions.append((phase.heading, _merge_sentences(lines)))
    return decisions


def _merge_sentences(lines: Sequence[str]) -> tuple[str, ...]:
    """Merge sentences that differ only in a name, and replace hyphens by minus signs."""
    names: dict[str, list[str]] = {}
    for line in lines:
        name, colon, rest = line.partition(": ")
        names.setdefault(rest if colon else line, []).append(name if colon else "")
    grouped = [f"{', '.join(own)}: {rest}" if own[0] else rest for rest, own in names.items()]
    return tuple(re.sub(r"(?<![\w-])-(?=\d)", "−", line) for line in grouped)


def missing(study: StudyFile, *names: str) -> str:
    """State which of the phases are not decided yet; empty if all are."""
    absent = [NUMBERS[name] for name in names if name not in study.decided]
    if not absent:
        return ""
    return f"Phase{'s' * (len(absent) > 1)} {listed(absent)} {'are' if len(absent) > 1 else 'is'} not decided yet."


def settings(study: StudyFile) -> list[tuple[str, str]]:
    """Return the settings of the search as text."""
    return [(key.replace("_", " "), setting_text(value)) for key, value in study.spec.items()]
