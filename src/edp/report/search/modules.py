"""The tables of a study's modules: phases 2 and 3, in the form of the thesis's Table 4.5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from edp.errors import count_of
from edp.report.search.facts import StudyFacts, known, of_phase, real
from edp.table import Column, Table, chance, figures
from edp.wording import interval

GROUPS = {
    "Structural gating": ("cylinder_gate", "temporal_difference"),
    "Sequence architecture": (*("cross_cylinder_attention", "gru", "layer_norm_lstm", "multi_scale_tcn", "zoneout"),),
    "Channel attention": ("attention_bridge", "global_average_pooling", "squeeze_excitation"),
    "Physics constraint": ("physics_residual",),
    "Output head": ("deeper_head", "glu_head", "stanh"),
}
"""The thesis's order of Table 4.5."""
OTHER = "Other"


def modules_tables(study: StudyFacts) -> tuple[Table, ...]:
    """Table 4.5: phases 2 and 3 side by side, and every test of phase 3."""
    if "screening" not in study.facts:
        return ()
    sheets = (_modules_thesis if study.mode == "thesis" else _modules_sound)(study)
    return tuple(sheet for sheet in sheets if sheet is not None)


def ordered(names: Sequence[str]) -> list[tuple[str, str]]:
    """Group and module in the thesis's order, unknown ones behind."""
    present = set(names)
    known_ones = [(group, name) for group, own in GROUPS.items() for name in own if name in present]
    listed = {name for _, name in known_ones}
    return [*known_ones, *((OTHER, name) for name in names if name not in listed)]


@of_phase("screening", ())
def _modules_sound(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[Table | None, ...]:
    evidence = _evidence(study)
    rows, marked = [], set()
    for group, name in ordered(facts["registered"]):
        effect = facts["modules"][name]
        entry = evidence.get(name)
        tested = entry is not None and entry["change"] is not None
        size = known(entry["d_z"]["value"]) if entry is not None and entry["d_z"] else None
        rows.append(
            (
                study.module(name),
                group,
                100 * real(effect["change"]),
                100 * real(entry["change"]) if entry is not None and tested else None,
                span(entry) if entry is not None and tested else None,
                real(entry["p"]) if entry is not None and tested else None,
                real(entry["adjusted"]) if entry is not None and tested else None,
                size,
                _verdict(study, name, entry, name in facts["passed"]),
            )
        )
        if entry is not None and entry["confirmed"]:
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
    caption = (
        f"Modules in phases 2 and 3; below zero is better, p is adjusted over all {len(facts['registered'])} modules"
    )
    return Table(caption, columns, tuple(rows), frozenset(marked), name="modules"), _tests(study), _effects(study)


@of_phase("screening", None)
def _effects(study: StudyFacts, facts: Mapping[str, Any]) -> Table | None:
    """Main effects of the two-level design."""
    rows = []
    for _, name in ordered(facts["registered"]):
        effect = facts["modules"][name]
        shares = (100 * real(effect["change"]), 100 * real(effect["importance"]))
        verdict = "goes on" if name in facts["passed"] else "stops"
        rows.append((study.module(name), shares[0], real(effect["p"]), shares[1], verdict))
    columns = (
        Column("Module"),
        Column("Change", "%", figures([], signed=True, decimals=2)),
        Column("p", "one-sided", chance),
        Column("Importance", "% of what is explained", figures([], decimals=0)),
        Column("Verdict", is_text=True),
    )
    caption = "Phase 2: main effects of the two-level design, on average over all other modules"
    return Table(caption, columns, tuple(rows), name="effects")


def _evidence(study: StudyFacts) -> dict[str, Mapping[str, Any]]:
    facts = study.facts.get("confirmation", {})
    return {entry["module"]: entry for entry in facts.get("evidence", ())}


def _verdict(study: StudyFacts, name: str, entry: Mapping[str, Any] | None, passed: bool) -> str:
    if not passed:
        return "stopped"
    if entry is None:
        return "not in phase 3" if "confirmation" in study.facts else "goes on"
    if entry["dropped_after"]:
        return f"dropped after {count_of(entry['dropped_after'], 'run')}"
    return "confirmed" if entry["confirmed"] else "not confirmed"


@of_phase("confirmation", None)
def _tests(study: StudyFacts, facts: Mapping[str, Any]) -> Table | None:
    """What other tests say of the modules that phase 3 tested."""
    rows = []
    for entry in facts["evidence"]:
        if entry["change"] is None:
            continue
        tests = (known(entry[name]) for name in ("p", "resampled_p", "paired_p", "mixed_p"))
        rows.append(
            (
                study.module(entry["module"]),
                int(entry["runs"]),
                *tests,
                span(entry["d_z"], 1.0) if entry["d_z"] else None,
                None if entry["stability"] is None else 100 * real(entry["stability"]),
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


@of_phase("screening", ())
def _modules_thesis(study: StudyFacts, facts: Mapping[str, Any]) -> tuple[Table | None, ...]:
    evidence = study.facts.get("confirmation", {}).get("evidence", ())
    metrics = list(dict.fromkeys(str(entry["metric"]) for entry in evidence))
    by_cell = {(entry["module"], entry["metric"]): entry for entry in evidence}
    confirmed = set(study.facts.get("confirmation", {}).get("confirmed", ()))
    rows, every, marked = [], [], set()
    for group, name in ordered(facts["registered"]):
        entry = by_cell.get((name, metrics[0])) if metrics else None
        tests = _thesis_cells(entry)
        verdict = "stopped" if name not in facts["passed"] else "goes on"
        if entry is not None:
            verdict = "confirmed" if name in confirmed else "not confirmed"
        rows.append((study.module(name), group, known(facts["modules"][name]["gain"]), *tests, verdict))
        if name in confirmed:
            marked.add(len(rows) - 1)
        for metric in metrics:
            if (name, metric) in by_cell:
                cell = by_cell[name, metric]
                every.append((study.module(name), metric.upper(), real(cell["beta"]), *_thesis_cells(cell),
                              "passed" if cell["passed"] else "not passed"))  # fmt: skip
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


def _thesis_cells(entry: Mapping[str, Any] | None) -> tuple[float | None, ...]:
    if entry is None:
        return (None,) * 5
    tests = (real(entry[name]) for name in ("printed_p", "p", "adjusted"))
    return (*tests, known(entry["d_z"]), 100 * real(entry["stability"]))


def span(entry: Mapping[str, Any], scale: float = 100.0) -> str | None:
    """An interval as text."""
    if entry.get("low") is None or entry.get("high") is None:
        return None
    return interval(scale * real(entry["low"]), scale * real(entry["high"]), signed=True)
