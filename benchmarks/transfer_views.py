"""Tables, verdicts and the chart of the benchmark ``transfer.py``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from common import Verdict, table, verdict
from edp.report.common.chart import BLUE, DROPPED, INK
from edp.workflows.transfer import METHODS

HORIZON = "10"
OURS, NONE = "full", "direct"
KEYS = ("mae", "r2", "bias", "rmse", "mse", "skew", "p95", "p99")
WORLDS = ("target", "air", "soil", "source")  # the target's logs, those in free air and in soil, the source's
SOILS = ("sandy_loam", "clay")  # one that logs of the target hold, and one that none holds


def interval(values: Sequence[float]) -> float:
    """Half the width of the 95 % interval of a mean."""
    count = len(values)
    return float(stdtrit(count - 1, 0.975) * np.std(values, ddof=1) / count**0.5) if count > 1 else float("nan")


def closed(mae: float, direct: float, limit: float) -> float:
    """Share of the way from direct transfer to the limit of predictability."""
    return (direct - mae) / (direct - limit)


def show(found: dict[str, Any], minutes_of_all: int) -> None:
    """Print all tables."""
    curves, limit = found["curves"], found["limit"]
    direct = curves[NONE][0]["mae"]
    minutes = sorted({m for sizes in curves.values() for m in sizes})
    print(f"\nk = {HORIZON}: mean absolute error on the test parts by minutes of logs, mm/s; the limit is {limit:.3g}")
    cells = {
        method: {m: f"{row['mae']:.3g} +- {row['interval']:.2g}" for m, row in rows.items()}
        for method, rows in curves.items()
    }
    table(
        ["method", *map(str, minutes)],
        [[METHODS[m].label, *(held.get(n, "-") for n in minutes)] for m, held in cells.items()],
    )
    for rival in ("scratch", "low_rank"):
        pairs = {m: np.subtract(curves[OURS][m]["logs"], row["logs"]) for m, row in curves.get(rival, {}).items()}
        said = ", ".join(f"{m} min {gain.mean():+.2f} +- {interval(gain):.2f}" for m, gain in pairs.items())
        print(f"{METHODS[OURS].label} less {METHODS[rival].label.lower()}, log by log: {said}")
    for minutes, row in sorted(m for sizes in found["foundation"].values() for m in sizes.items()):
        print(f"from the network of many machines, {minutes} min: {row['mae']:.3g} +- {row['interval']:.2g}")
    print(f"\nall {minutes_of_all} min of logs, both worlds")
    rows = []
    held = {METHODS[method].label: sizes[max(sizes)] for method, sizes in curves.items()}
    held |= {f"{METHODS[m].label}, of many machines": sizes[max(sizes)] for m, sizes in found["foundation"].items()}
    for label, scored in held.items():
        for world, scores in scored["worlds"].items():
            for name, row in scores.items():
                rows.append([label, world, name, *(row.get(key, "-") for key in KEYS)])
    table(["method", "world", "cylinder", *KEYS], rows)
    print("\nof the way from direct transfer to the limit: ", end="")
    print(", ".join(f"{m} {closed(s[max(s)]['mae'], direct, limit):.0%}" for m, s in curves.items() if m != NONE))
    print("\ndigs and levelling of new logs, mm/s")
    table(
        ["method", *SOILS],
        [[METHODS[m].label, *(found["soils"][soil][m] for soil in SOILS)] for m in found["soils"][SOILS[0]]],
    )
    print("\nsmall networks with a physics base and its geometry, mm/s")
    heads = ["base", "on M22", "C14 as it is", "C14 fine-tuned"]
    table(heads, [[name, row["own"], row[NONE], row[OURS]] for name, row in found["physics"].items()])


def verdicts_of(
    curves: dict[str, Any], foundation: dict[str, Any], minutes_of_all: int, quick: bool
) -> Iterator[Verdict]:
    """Every goal that this run can speak to."""
    direct, ours = curves[NONE][0], curves[OURS]
    best = ours[minutes_of_all]
    yield verdict("fine-tuned over direct transfer, all logs", best["mae"], direct["mae"], "<= 0.36", "mm/s", quick)
    rows = [row for name, row in best["worlds"]["target"].items() if name != "mean"]
    yield verdict("least R2 of a cylinder, all logs", min(row["r2"] for row in rows), 1.0, ">= 0.97", "1", quick)
    bias = max(abs(row["bias"]) / row["mae"] for row in rows)
    if "air" in best["worlds"]:
        air, before = best["worlds"]["air"], direct["worlds"]["air"]
        yield verdict(
            "fine-tuned over direct transfer, logs in free air",
            air["mean"]["mae"],
            before["mean"]["mae"],
            "<= 0.36",
            "mm/s",
            quick,
        )
        least = min(row["r2"] for name, row in air.items() if name != "mean")
        yield verdict("least R2 of a cylinder, logs in free air", least, 1.0, ">= 0.97", "1", quick)
    yield verdict("largest bias over MAE of a cylinder", bias, 1.0, "<= 0.05", "1", quick)
    for minutes in sorted(set(ours) & set(curves["scratch"])):
        alone = curves["scratch"][minutes]["mae"]
        yield verdict(
            f"fine-tuned over from scratch, {minutes} min", ours[minutes]["mae"], alone, "<= 1", "mm/s", quick
        )
    few = min(5, minutes_of_all)
    # Each beginning against itself: a better one lowers both errors, and says nothing of what few minutes bring.
    for begun, own in (("M22's network", curves), ("network of many machines", foundation)):
        if own:
            least = min(rows[few]["mae"] for rows in own.values() if few in rows)
            whole = own[OURS][minutes_of_all]["mae"]
            yield verdict(f"{begun}: best with {few} min over all logs", least, whole, "<= 1.1", "mm/s", quick)
    if foundation:
        zero = foundation[NONE][0]["mae"]
        yield verdict("network of many machines over direct transfer", zero, direct["mae"], "<= 0.6", "mm/s", quick)
        all_logs = foundation[OURS][minutes_of_all]["mae"]
        yield verdict("the same fine-tuned over direct transfer", all_logs, direct["mae"], "<= 0.36", "mm/s", quick)
    if "rehearsal" in curves:
        both = curves["rehearsal"][minutes_of_all]["worlds"]
        yield verdict(
            "both worlds: in the target", both["target"]["mean"]["mae"], best["mae"], "<= 1.05", "mm/s", quick
        )
        own = direct["worlds"]["source"]["mean"]["mae"]
        yield verdict("both worlds: in the source", both["source"]["mean"]["mae"], own, "<= 1.05", "mm/s", quick)


def draw(figure: Any, curves: dict[str, Any], limit: float) -> None:
    """Error by minutes of logs."""
    axes = figure.subplots()
    figure.set_size_inches(7.2, 4.2)
    direct = curves[NONE][0]["mae"]
    axes.axhline(direct, color=DROPPED, linestyle="--", linewidth=1.2)
    axes.annotate("direct transfer", (1, direct), xytext=(6, -11), textcoords="offset points", color=DROPPED)
    axes.axhline(limit, color=DROPPED, linestyle=":", linewidth=1.2)
    axes.annotate("limit of predictability", (1, limit), xytext=(0, 4), textcoords="offset points", color=DROPPED)
    inks = dict(zip((OURS, "scratch", "ridge_arx"), (BLUE, INK, "#b45309"), strict=True))
    marks = dict(zip((m for m in curves if m not in inks), "sD^vP*X", strict=False))
    for method, sizes in curves.items():
        if method == NONE:
            continue
        minutes = sorted(sizes)
        label, maes = METHODS[method].label, [sizes[m]["mae"] for m in minutes]
        if method in inks:
            reach = [sizes[m]["interval"] for m in minutes]
            axes.errorbar(minutes, maes, yerr=reach, color=inks[method], marker="o", capsize=3, label=label)
        else:
            axes.plot(minutes, maes, color="#66717d", marker=marks[method], linestyle=":", linewidth=0.8, label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = sorted({m for sizes in curves.values() for m in sizes} - {0})
    axes.set_xticks(ticks, [str(m) for m in ticks])
    axes.set_yticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axes.minorticks_off()
    axes.set_xlabel("Minutes of the target's logs that train and validate")
    axes.set_ylabel("Mean absolute error, mm/s")
    axes.set_title("From M22 in free air to a worn C14 in soil, 100 ms ahead")
    axes.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.06))
