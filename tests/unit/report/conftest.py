"""A synthetic run folder: every file a run writes, small, and true to itself (scores computed from the predictions)."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from browser import browser as browser
from safetensors.numpy import save_file

HORIZONS = (1, 5, 10)
TARGETS = (
    {"name": "CylVels_1", "description": "Boom cylinder velocity", "unit": "mm/s", "factor": 1000.0},
    {"name": "CylVels_2", "description": "Stick cylinder velocity", "unit": "mm/s", "factor": 1000.0},
    {"name": "CylVels_3", "description": "Bucket cylinder velocity", "unit": "mm/s", "factor": 1000.0},
)
MODELS = {
    "network": ("Hybrid TCN-LSTM", 0.30, 1850.0),
    "persistence": ("Persistence", 1.0, 0.0),
    "ridge_arx": ("Ridge ARX", 0.58, 2.4),
    "gradient_boosting": ("Boosted trees", 0.49, 96.0),
}


def motion(random: np.random.Generator, samples: int) -> np.ndarray:
    """(time, target) smooth velocities in m/s with pauses."""
    knots = random.normal(0.0, 0.11, (samples // 90 + 4, len(TARGETS)))
    knots[random.random(knots.shape) < 0.35] = 0.0
    slow = np.repeat(knots, 90, axis=0)[: samples + 120]
    kernel = np.hanning(90) / np.hanning(90).sum()
    smooth = np.stack([np.convolve(slow[:, i], kernel, "same") for i in range(slow.shape[1])], axis=1)
    return smooth[:samples] + random.normal(0.0, 8e-4, (samples, len(TARGETS)))


def ahead(random: np.random.Generator, truth: np.ndarray, skill: float) -> np.ndarray:
    """(time, horizon, target) persistence pulled towards the truth: `skill` 1 is persistence, 0 an oracle."""
    out = np.full((len(truth), len(HORIZONS), truth.shape[1]), np.nan)
    for column, k in enumerate(HORIZONS):
        noise = 2e-3 * skill * np.sqrt(k) * random.standard_t(4, (len(truth) - k, truth.shape[1]))
        out[:-k, column] = truth[k:] + skill * (truth[:-k] - truth[k:]) + noise
    return out


def summary(errors: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    size = np.abs(errors)
    mae, rmse = float(size.mean()), float(np.sqrt((errors**2).mean()))
    p95, p99 = (float(value) for value in np.quantile(size, (0.95, 0.99)))
    return {
        "mae": mae, "rmse": rmse, "p95": p95, "p99": p99, "bias": float(errors.mean()), "count": int(errors.size),
        "composite": 0.4 * mae + 0.15 * rmse + 0.25 * p95 + 0.2 * p99,
        "r2": 1 - float((errors**2).sum() / ((truth - truth.mean()) ** 2).sum()),
    }  # fmt: skip


def scored(model: str, truths: dict[str, np.ndarray], predicted: dict[str, np.ndarray]) -> dict:
    label, _, seconds = MODELS[model]
    out: dict = {"label": label, "seconds": seconds, "overall": {}, "recordings": {}, "spread": {}, "by_speed": {}}
    for column, k in enumerate(HORIZONS):
        truth = {name: 1000 * value[k:] for name, value in truths.items()}
        error = {name: 1000 * value[:-k, column] - truth[name] for name, value in predicted.items()}
        joined, all_truth = np.concatenate(list(error.values())), np.concatenate(list(truth.values()))
        overall = {"mean": summary(joined, all_truth)}
        for i, target in enumerate(TARGETS):
            overall[target["name"]] = summary(joined[:, i], all_truth[:, i])
        out["overall"][str(k)] = overall
        for name in truths:
            out["recordings"].setdefault(name, {})[str(k)] = {"mean": summary(error[name], truth[name])}
        maes = np.array([np.abs(value).mean() for value in error.values()])
        q25, median, q75 = (float(value) for value in np.quantile(maes, (0.25, 0.5, 0.75)))
        out["spread"][str(k)] = {
            "median": median, "q25": q25, "q75": q75, "min": float(maes.min()), "max": float(maes.max()),
            "std": float(maes.std()),
        }  # fmt: skip
        speed, edges = np.abs(all_truth), (0, 10, 25, 50, 100, 200)
        out["by_speed"][str(k)] = []
        for low, high in itertools.pairwise(edges):
            inside = (speed >= low) & (speed < high)
            mae = float(np.abs(joined[inside]).mean()) if inside.any() else None
            out["by_speed"][str(k)].append({"low": low, "high": high, "count": int(inside.sum()), "mae": mae})
        errors = {target["name"]: float(np.abs(joined[:, i]).mean()) for i, target in enumerate(TARGETS)}
        rest = {name: None if i == 0 else mae for i, (name, mae) in enumerate(errors.items())}
        out.setdefault("by_situation", {})[str(k)] = [
            {"situation": "other", "ticks": len(joined), "share": 0.9, "of_error": 0.95, "mae": errors},
            {"situation": "rest", "ticks": 40, "share": 0.1, "of_error": 0.05, "mae": rest},
        ]
    return out


def write_training(folder: Path) -> None:
    (folder / "config.toml").write_text('[model]\nname = "hybrid_tcn_lstm"\nunits = 48\n\n[training]\nseed = 7\n')
    held = {"recordings": 24, "hours": 1.8}
    provenance = {
        "edp_version": "0.1.0", "created": "2026-03-04T10:20:30Z", "command": "edp train quick --seed 7", "seed": 7,
        "environment": {"python": "3.11.9", "torch": "2.6.0", "platform": "Linux x86_64"}, "regime": "chunk",
        "data": {"source": "synthetic excavator", "rate_hz": 100.0, "train": held, "digest": "sha256:4c1f0a",
                 "validation": {"recordings": 6, "hours": 0.4}, "test": {"recordings": 12, "hours": 0.9}},
        "seconds": 1850.0, "parameters": 41283, "device": "cpu",
    }  # fmt: skip
    (folder / "provenance.json").write_text(json.dumps(provenance))
    random, lines, best = np.random.default_rng(3), [], np.inf
    for epoch in range(1, 41):
        loss = 0.9 * np.exp(-epoch / 7) + 0.06
        validation = loss * 1.08 + 0.0006 * max(epoch - 26, 0) + random.normal(0, 0.004)
        lines.append({
            "epoch": epoch, "updates": epoch * 310, "train_loss": loss + random.normal(0, 0.002),
            "validation_loss": validation, "validation_mae": 42 * validation, "seconds": 46.0,
            "learning_rate": 1e-3 * 0.5 * (1 + np.cos(np.pi * epoch / 41)), "best": bool(validation < best),
        })  # fmt: skip
        best = min(best, validation)
    (folder / "history.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n")


def write_evaluation(folder: Path, recordings: int, samples: int) -> None:
    random = np.random.default_rng(11)
    truths = {f"trench_{i:02d}": (0.5 + random.random()) * motion(random, samples) for i in range(1, recordings + 1)}
    predicted = {
        model: {name: ahead(random, truth, skill) for name, truth in truths.items()}
        for model, (_, skill, _) in MODELS.items()
    }
    scores = {
        "schema": 1,
        "task": {"name": "Cylinder velocities", "horizons": list(HORIZONS), "rate_hz": 100.0, "mode": "delta"},
        "targets": list(TARGETS),
        "models": {model: scored(model, truths, parts) for model, parts in predicted.items()},
    }
    (folder / "scores.json").write_text(json.dumps(scores))
    arrays = {}
    for name in list(truths)[:3]:
        arrays[f"{name}/truth"] = truths[name].astype(np.float32)
        for model in ("network", "ridge_arx"):
            arrays[f"{name}/{model}"] = predicted[model][name].astype(np.float32)
    save_file(arrays, folder / "predictions.safetensors")


def write_footprint(folder: Path) -> None:
    rows = [("Temporal convolutions", 18240, 17920, 896000), ("LSTM", 18624, 18432, 921600), ("Head", 4419, 4400, 4400)]
    checks = [
        ("Cycles per tick", 163000, 720000, "cycles", "4 multiply-accumulates per 10 cycles assumed"),
        ("Parameters, INT8", 41283, 100000, "B", ""), ("Working memory", 31200, 500000, "B", ""),
        ("Flash, FP32", 2165132, 2000000, "B", "INT8 weights would need a quarter"),
    ]  # fmt: skip
    footprint = {
        "parameters": 41283, "parameters_folded": 40960, "macs_tick": 40752, "macs_window": 1822000, "window": 50,
        "peak_activation_bytes": 6144, "state_bytes": 25056,
        "estimates": [
            {"number_format": "float32", "parameter_bytes": 165132},
            {"number_format": "w8a16", "parameter_bytes": 45283},
        ],
        "peak_activation_bytes_window": 51200,
        "rows": [dict(zip(("part", "parameters", "macs_tick", "macs_window"), row, strict=True)) for row in rows],
        "budget": {"name": "180 MHz, 4 ms per tick", "cycles": 720000, "parameter_bytes": 100000, "ram_bytes": 500000},
        "verdict": [
            {"what": what, "value": value, "limit": limit, "unit": unit, "fits": value <= limit, "note": note}
            for what, value, limit, unit, note in checks
        ],
    }  # fmt: skip
    (folder / "footprint.json").write_text(json.dumps(footprint))


def write_run(folder: Path, recordings: int = 12, samples: int = 4200) -> Path:
    """Every file of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    write_training(folder)
    write_evaluation(folder, recordings, samples)
    write_footprint(folder)
    return folder


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Builder of run folders."""
    return lambda name="run", **size: write_run(tmp_path / name, **({"recordings": 4, "samples": 900} | size))


@pytest.fixture
def run_folder(make_run: Callable[..., Path]) -> Path:
    return make_run()
