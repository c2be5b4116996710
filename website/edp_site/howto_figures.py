"""Figures of the how-to pages: drawn from simulated data, from kept results, or taken of pages that commands write.

``python -m edp_site.howto_figures [NAME...]`` writes them to ``docs/images``; pages are pictured by Chromium.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt

from edp_site.notebooks import run_line

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
LABELS = {"nmpc": "predictive control", "pi": "PI"}
TRAINING = "--set training.epochs={epochs} --set training.updates=40"
FIGURES: dict[str, Callable[[Path], None]] = {}
"""Functions that draw a figure, by name; each runs in a folder with simulated logs in ``data`` and gets its path."""


def figure(draw: Callable[[Path], None]) -> Callable[[Path], None]:
    """Register a function under its name."""
    FIGURES[draw.__name__] = draw
    return draw


def save(path: Path) -> None:
    """Write the current plot as a PNG."""
    plt.savefig(path, dpi=90, bbox_inches="tight", metadata={"Software": None})
    plt.close("all")


def picture(page: Path, path: Path, height: int = 900) -> None:
    """Write the top of an HTML page as a PNG of 1,000 pixels width.

    Raises:
        RuntimeError: there is no Chromium.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise RuntimeError("the pictures of pages need Chromium: install it, or name other figures")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=8000"]
    target = [f"--window-size=1000,{height}", f"--screenshot={path}", page.resolve().as_uri()]
    subprocess.run([browser, *options, *target], check=True, capture_output=True, timeout=120)


def details(name: str) -> Any:
    """Return the details of a kept result."""
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text(encoding="utf-8"))["details"]


@figure
def map_units(path: Path) -> None:
    """Draw one velocity read with two units."""
    time_s = np.arange(0, 10, 0.01)
    velocity = 0.12 * np.sin(1.3 * time_s) + 0.04 * np.sin(4.1 * time_s)
    plt.figure(figsize=(7, 2.4))
    plt.plot(time_s, velocity, label='unit = "mm/s": 0.16 m/s at most')
    plt.plot(time_s, 10 * velocity, label='unit = "cm/s": 1.6 m/s, which no cylinder reaches', linewidth=1)
    plt.xlabel("time, s")
    plt.ylabel("velocity, m/s")
    plt.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0))
    save(path)


@figure
def repair_gaps(path: Path) -> None:
    """Draw a log with a gap that is held and cut."""
    from edp.logs import Repair, read_recording
    from edp.signals import SignalMap

    time_s = np.arange(0, 4, 0.01)
    values = np.sin(3 * time_s)
    there = (time_s < 1.5) | (time_s > 2.0)
    np.savetxt("gap.csv", np.c_[time_s, values][there], delimiter=",", header="t,speed", comments="", fmt="%.4f")
    everything = SignalMap(others=True, channels={})
    plt.figure(figsize=(7, 2.2))
    plt.plot(time_s, values, color="0.8", linewidth=4, label="what happened")
    held = read_recording("gap.csv", everything, repair=Repair(gaps="hold"))
    cut = read_recording("gap.csv", everything, repair=Repair(gaps="cut"))
    plt.plot(np.arange(held.samples) / held.rate_hz, held.values[:, 0], label="gaps=hold", linewidth=1)
    start = 2.01 if cut.samples > 160 else 0.0
    plt.plot(
        start + np.arange(cut.samples) / cut.rate_hz, cut.values[:, 0], label="gaps=cut", linewidth=2, linestyle="--"
    )
    plt.xlabel("time, s")
    plt.legend(loc="lower left")
    save(path)


@figure
def screening(path: Path) -> None:
    """Picture the page of a screening."""
    run_line("edp data screen data --out screen --targets CylVels_1 --horizon 10 --set screen.max_lag=60 --no-pictures")
    picture(Path("screen/report.html"), path)


@figure
def coverage(path: Path) -> None:
    """Picture the page of a check of the data."""
    run_line("edp data check data --page coverage.html")
    picture(Path("coverage.html"), path)


def train(name: str, epochs: int = 2, *more: str) -> Path:
    """Train a small run of the preset quick, once."""
    run = Path("runs") / name
    if not run.exists():
        line = f"edp train data --preset quick {TRAINING.format(epochs=epochs)} {' '.join(more)} --out {run}"
        run_line(line)
        run_line(f"edp evaluate {run} --baselines persistence,ridge_arx")
    return run


@figure
def learning_curves(path: Path) -> None:
    """Draw the validation error by epoch for three learning rates."""
    plt.figure(figsize=(7, 2.6))
    for rate, says in (("6e-3", "the preset"), ("2e-4", "too small"), ("0.3", "too large")):
        run = train(f"rate_{rate}", 6, f"--set training.optimizer.learning_rate={rate}")
        lines = [json.loads(line) for line in (run / "history.jsonl").read_text(encoding="utf-8").splitlines()]
        key = next(key for key in ("validation", "validation_mae", "score") if key in lines[0])
        plt.plot([line["epoch"] for line in lines], [line[key] for line in lines], marker="o", label=f"{rate}, {says}")
    plt.xlabel("epoch")
    plt.ylabel("validation error")
    plt.legend(title="learning rate", loc="upper left", bbox_to_anchor=(1.01, 1.0))
    save(path)


@figure
def intervals(path: Path) -> None:
    """Draw predictions with their intervals."""
    import edp

    run = train("intervals", 6, "--set model.output.kind=quantiles --set training.loss.kind=quantile")
    model, recording = edp.load(run), edp.read("data")[0]
    predictions = model.predict(recording)
    bounds = (predictions.bounds or ())[0]
    lower, upper = bounds[:, 0, 0], bounds[:, 0, 1]
    shown, time_s = slice(1000, 1600), np.arange(recording.samples) / recording.rate_hz
    ahead = time_s[shown] + model.horizons[0] / recording.rate_hz
    plt.figure(figsize=(7, 2.4))
    plt.fill_between(ahead, lower[shown, 0, 0], upper[shown, 0, 0], alpha=0.3, label="90 % interval, 100 ms before")
    plt.plot(time_s[shown], recording.column(model.targets[0])[shown], label="measured", linewidth=1)
    plt.xlabel("time, s")
    plt.ylabel("boom velocity, m/s")
    plt.legend(loc="upper right")
    save(path)


@figure
def compare(path: Path) -> None:
    """Picture the comparison of three runs."""
    runs = [train("rate_6e-3", 6), train("units_16", 6, "--set model.backbone.units=16"), train("rate_2e-4", 6)]
    run_line(f"edp compare {' '.join(map(str, runs))} --out compare.html")
    picture(Path("compare.html"), path)


@figure
def footprint(path: Path) -> None:
    """Draw the parameters of the parts of a network."""
    run = train("rate_6e-3", 6)
    parts = json.loads(run_line(f"edp compress estimate {run} --json"))["rows"]
    shown = [part for part in parts if part["parameters"]]
    plt.figure(figsize=(7, 2.2))
    plt.barh([part["part"] for part in shown], [part["parameters"] for part in shown])
    plt.xlabel("parameters")
    save(path)


@figure
def adaptation(path: Path) -> None:
    """Draw the errors of the kept result with and without adaptation."""
    mae = details("adaptation")["mae"]
    plt.figure(figsize=(7, 2.4))
    for number, (name, label) in enumerate((("frozen", "network"), ("adapted", "network and adaptation"))):
        plt.bar(np.arange(len(mae)) + 0.4 * number, [mae[one][name] for one in mae], 0.4, label=label)
    plt.xticks(np.arange(len(mae)) + 0.2, list(mae))
    plt.ylabel("MAE, mm/s")
    plt.legend()
    save(path)


@figure
def mpc_errors(path: Path) -> None:
    """Draw the path errors of the kept results for three controllers."""
    network, grey = (details(f"closed_loop_{name}") for name in ("nmpc", "grey"))
    bars = {
        "PI": network["nmpc"]["loops"]["as it was"]["pi"],
        "predictive control,\nrecurrent plant model": network["nmpc"]["loops"]["as it was"]["nmpc"],
        "predictive control,\ngrey box": grey["grey"]["loops"]["as it was"]["nmpc"],
    }
    errors = {name: np.array(one["path_rms_mm"]) for name, one in bars.items()}
    plt.figure(figsize=(7, 2.6))
    for place, values in enumerate(errors.values()):
        plt.scatter(np.full(len(values), place), values, s=14, alpha=0.6)
        plt.hlines(values.mean(), place - 0.25, place + 0.25)
    plt.yscale("log")
    plt.xticks(range(len(errors)), list(errors))
    plt.ylabel("path error, mm (rms)")
    plt.title("Each point is one of 18 lines, the line is the mean")
    save(path)


@figure
def calibration(path: Path) -> None:
    """Draw the free-run errors of the kept result for calibrated machines."""
    machines = details("identify_short")
    names = {"static map": "static map", "machine M22": "guess", "identified machine": "calibrated machine"}
    plt.figure(figsize=(7, 2.4))
    for number, (name, label) in enumerate(names.items()):
        values = [one["models"][name]["velocity_mae"]["mean"] for one in machines.values()]
        plt.bar(np.arange(len(values)) + 0.27 * number, values, 0.27, label=label)
    plt.xticks(np.arange(len(machines)) + 0.27, list(machines))
    plt.ylabel("free-run MAE, mm/s")
    plt.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    save(path)


@figure
def excitations(path: Path) -> None:
    """Draw the boom velocity of six types of excitation."""
    from edp.sim import Scenario, simulate

    figure, axes = plt.subplots(3, 2, figsize=(8, 4.2), sharex=True)
    names = ("isolated", "combined", "aprbs", "reversals", "grading", "dig")
    for axis, name in zip(axes.flat, names, strict=True):
        recording = simulate(Scenario(excitation=name, duration_s=30.0, seed=1))
        axis.plot(np.arange(recording.samples) / recording.rate_hz, recording.column("CylVels_1"), linewidth=0.8)
        axis.set_title(name, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    figure.supylabel("boom velocity, m/s")
    figure.tight_layout()
    save(path)


@figure
def fault(path: Path) -> None:
    """Draw the boom stroke without and with an internal leak."""
    from edp.sim import Scenario, simulate

    plt.figure(figsize=(7, 2.4))
    for faults, label in (((), "healthy"), (("internal_leak:boom:10L/min@10s",), "leak of 10 L/min from 10 s on")):
        recording = simulate(Scenario(excitation="isolated", duration_s=40.0, seed=6, faults=list(faults)))
        time_s = np.arange(recording.samples) / recording.rate_hz
        plt.plot(time_s, 1000 * recording.column("CylStroke_1"), label=label, linewidth=1)
    plt.axvline(10.0, color="0.5", linestyle=":")
    plt.xlabel("time, s")
    plt.ylabel("boom stroke, mm")
    plt.legend()
    save(path)


@figure
def twin_report(path: Path) -> None:
    """Picture the report of a plant model."""
    settings = "--set \"twin.candidates=['static','arx']\" --set evaluation.duration_s=30"
    run_line(f"edp train data --focus simulation {settings} --out runs/twin")
    run_line("edp report runs/twin")
    picture(Path("runs/twin/report.html"), path, height=1500)


@figure
def monitor(path: Path) -> None:
    """Picture the page of a monitor with an alarm."""
    from edp.logs import write_recording
    from edp.testing.monitor import rig_sessions

    Path("healthy").mkdir()
    Path("today").mkdir()
    for number, session in enumerate(rig_sessions(19, 2000, seed=4)):
        if number == 18:
            session.values[800:, 0] += 3 * np.std(session.values[:, 0])
        write_recording(session, Path("today" if number == 18 else "healthy") / f"session_{number:02d}.parquet")
    run_line("edp monitor fit healthy --hours-per-false-alarm 0.04 --time-budget 0.1min --machine none --out watch")
    run_line("edp monitor run watch today --out watched")
    run_line("edp monitor report watched")
    picture(Path("watched/report.html"), path)


@figure
def study(path: Path) -> None:
    """Picture the report of a search of seconds."""
    settings = (
        'task={targets=["CylVels_1"], horizons=[1]}',
        'model={backbone={kind="lstm", units=4}, window=5, head={hidden=4}}',
        "training.chunks={length=32, batch=4, burn_in=5}",
        'search={horizon=1, backbones=["lstm", "gru"], features=["FG1", "FG2"], updates=40, folds=2}',
        "search={isolation={runs=4, seeds=1}, calibration={trials=4}, compression={on=false}}",
        "search.space={units=[4, 8], kernel=false}",
    )
    changes = " ".join(f"--set '{one}'" for one in settings)
    run_line(f"edp search data --out study --preset quick --phase calibration --workers 2 {changes}")
    run_line("edp search report study --no-pictures")
    picture(Path("study/report.html"), path)


@contextlib.contextmanager
def workshop() -> Iterator[None]:
    """Work in a temporary folder with simulated logs."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            run_line("edp simulate data --duration 8min --recordings 8 --seed 3")
            yield
        finally:
            os.chdir(before)


def main(names: list[str]) -> None:
    """Draw the named figures, or all."""
    plt.switch_backend("agg")
    with workshop():
        for name in names or list(FIGURES):
            FIGURES[name](IMAGES / f"{name}.png")
            print(f"{name}: {(IMAGES / f'{name}.png').stat().st_size:,} bytes", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
