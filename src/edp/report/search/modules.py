"""The tables of a study's modules: phases 2 and 3, in the form of the thesis's Table 4.5."""

from __future__ import annotations

from collections.abc import Sequence

from edp.errors import count_of
from edp.evaluation.study import StudyFile
from edp.evaluation.study_facts import SoundConfirmation, SoundScreening, ThesisConfirmation, ThesisScreening
from edp.report.search.facts import finite, require_phase
from edp.stats.confirm import ModuleEvidence
from edp.stats.thesis_confirm import ThesisEvidence
from edp.table import Column, Table, chance, figures
from edp.wording import interval

GROUPS = {
    "Structural gating": ("cylinder_gate", "temporal_difference"),
    "Sequence architecture": (*("cross_cylinder_attention", "gru", "layer_norm_lstm", "multi_scale_tcn", "zoneout"),),
    "Channel attention": ("attention_bridge", "global_average_pooling", "squeeze_excitation"),
    "Physics constraint": ("physics_residual",),
    "Output head": ("deeper_head", "glu_head", "stanh"),
}
"""Groups of modules in the order of the thesis, Table 4.5."""
OTHER = "Other"


def modules_tables(study: StudyFile) -> tuple[Table, ...]:
    """Return the table 4.5: phases 2 and 3 side by side, and every test of phase 3."""
    tables = (_modules_thesis if study.mode == "thesis" else _modules_sound)(study)
    return tuple(table for table in tables if table is not None)


def ordered(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return group and module in the thesis's order, followed by unknown ones."""
    present = set(names)
    known_ones = [(group, name) for group, own in GROUPS.items() for name in own if name in present]
    listed = {name for _, name in known_ones}
    return [*known_ones, *((OTHER, name) for name in names if name not in listed)]


@require_phase(SoundScreening, ())
def _modules_sound(study: StudyFile, facts: SoundScreening) -> tuple[Table | None, ...]:
    confirmation = study.facts(SoundConfirmation)
    evidence = {} if confirmation is None else {entry.module: entry for entry in confirmation.evidence}
    rows, marked = [], set()
    for group, name in ordered(facts.registered):
        effect = facts.modules[name]
        entry = evidence.get(name)
        size = finite(entry.d_z.value) if entry is not None and entry.d_z is not None else None
        tests: tuple[float | str | None, ...] = (None,) * 4
        if entry is not None and entry.change is not None:
            tests = (100 * entry.change, span(entry.low, entry.high), entry.p, entry.adjusted)
        rows.append(
            (
                study.module(name),
                group,
                100 * effect.change,
                *tests,
                size,
                _verdict(study, entry, name in facts.passed),
            )
        )
        if entry is not None and entry.confirmed:
            marked.add(len(rows) - 1)
    columns = (
        Column("Module"),
        Column("Group", is_text=True),
        Column("Phase 2", "change, %", figures([], signed=True, decimals=2)),
        Column("Phase 3", "change, %", figures([], signed=True, decimals=2)),
        Column("95 % interval", "%"),
        Column("p", "one-sided", chance),
        Column("p", "adjusted", chance),
        Column("d_z", "Cohen", figures([], signed=True, decimals=2)),
        Column("Verdict", is_text=True),
    )
    caption = f"Modules in phases 2 and 3; below zero is better, p is adjusted over all {len(facts.registered)} modules"
    return Table(caption, columns, tuple(rows), frozenset(marked), name="modules"), _tests(study), _effects(study)


@require_phase(SoundScreening, None)
def _effects(study: StudyFile, facts: SoundScreening) -> Table | None:
    """Return the main effects of the two-level design."""
    rows = []
    for _, name in ordered(facts.registered):
        effect = facts.modules[name]
        verdict = "goes on" if name in facts.passed else "stops"
        rows.append((study.module(name), 100 * effect.change, effect.p, 100 * effect.importance, verdict))
    columns = (
        Column("Module"),
        Column("Change", "%", figures([], signed=True, decimals=2)),
        Column("p", "one-sided", chance),
        Column("Importance", "% of what is explained", figures([], decimals=0)),
        Column("Verdict", is_text=True),
    )
    caption = "Phase 2: main effects of the two-level design, on average over all other modules"
    return Table(caption, columns, tuple(rows), name="effects")


def _verdict(study: StudyFile, entry: ModuleEvidence | None, passed: bool) -> str:
    if not passed:
        return "stopped"
    if entry is None:
        return "not in phase 3" if "confirmation" in study.decided else "goes on"
    if entry.dropped_after:
        return f"dropped after {count_of(entry.dropped_after, 'run')}"
    return "confirmed" if entry.confirmed else "not confirmed"


@require_phase(SoundConfirmation, None)
def _tests(study: StudyFile, facts: SoundConfirmation) -> Table | None:
    """Return the results of other tests for the modules that phase 3 tested."""
    rows = []
    for entry in facts.evidence:
        if entry.change is None:
            continue
        tests = map(finite, (entry.p, entry.resampled_p, entry.paired_p, entry.mixed_p))
        rows.append(
            (
                study.module(entry.module),
                entry.runs,
                *tests,
                None if entry.d_z is None else span(entry.d_z.low, entry.d_z.high, 1.0),
                None if entry.stability is None else 100 * entry.stability,
            )
        )
    columns = (
        Column("Module"),
        Column("Runs"),
        Column("Clustered t", "p, decides", chance),
        Column("Resampled t", "p, Nadeau and Bengio", chance),
        Column("Paired t", "p", chance),
        Column("Mixed model", "p, eq. 2.22", chance),
        Column("d_z", "95 % interval"),
        Column("Runs won", "%", figures([], decimals=0)),
    )
    return Table("Other tests on the same trainings; all one-sided, not adjusted", columns, tuple(rows), name="tests")


@require_phase(ThesisScreening, ())
def _modules_thesis(study: StudyFile, facts: ThesisScreening) -> tuple[Table | None, ...]:
    confirmation = study.facts(ThesisConfirmation) or ThesisConfirmation(confirmed=(), evidence=())
    metrics = list(dict.fromkeys(entry.metric for entry in confirmation.evidence))
    by_cell = {(entry.module, entry.metric): entry for entry in confirmation.evidence}
    confirmed = set(confirmation.confirmed)
    rows, every, marked = [], [], set()
    for group, name in ordered(facts.registered):
        entry = by_cell.get((name, metrics[0])) if metrics else None
        tests = _thesis_cells(entry)
        verdict = "stopped" if name not in facts.passed else "goes on"
        if entry is not None:
            verdict = "confirmed" if name in confirmed else "not confirmed"
        rows.append((study.module(name), group, facts.modules[name].gain, *tests, verdict))
        if name in confirmed:
            marked.add(len(rows) - 1)
        for metric in metrics:
            if (name, metric) in by_cell:
                cell = by_cell[name, metric]
                every.append((study.module(name), metric.upper(), cell.beta, *_thesis_cells(cell),
                              "passed" if cell.passed else "not passed"))  # fmt: skip
    tests_columns = (
        Column("p", "as printed", chance),
        Column("p", "mixed model", chance),
        Column("p", "adjusted", chance),
        Column("d_z", "Cohen", figures([], signed=True, decimals=2)),
        Column("Runs won", "%", figures([], decimals=0)),
    )
    gain = Column("Δp₂", study.unit, figures([row[2] for row in rows], signed=True))
    first = (
        Column("Module"),
        Column("Group", is_text=True),
        gain,
        *tests_columns,
        Column("Verdict", is_text=True),
    )
    shown = f"; tests on {metrics[0].upper()}, a module is confirmed on any metric" if metrics else ""
    caption = f"Modules in phases 2 and 3, the thesis's procedure: better is Δp₂ > 0 and d_z < 0{shown}"
    second = (
        *(
            Column("Module"),
            Column("Metric"),
            Column("β₁", study.unit, figures([row[2] for row in every], signed=True)),
        ),
        *(*tests_columns, Column("Gates")),
    )
    return (
        Table(caption, first, tuple(rows), frozenset(marked), name="modules"),
        Table("The thesis's gates on every metric", second, tuple(every), name="tests"),
    )


def _thesis_cells(entry: ThesisEvidence | None) -> tuple[float | None, ...]:
    if entry is None:
        return (None,) * 5
    return entry.printed_p, entry.p, entry.adjusted, finite(entry.d_z), 100 * entry.stability


def span(low: float | None, high: float | None, scale: float = 100.0) -> str | None:
    """Return an interval as text, None if an end is not finite."""
    low, high = finite(low), finite(high)
    return None if low is None or high is None else interval(scale * low, scale * high, signed=True)
