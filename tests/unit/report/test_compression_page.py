"""The page of a search for a smaller network, from what lies on disk."""

import pytest
from page_text import check_text

from edp.report import write_compression_page
from edp.storage import write_json


def row(name, recipe, mae, parameters, fits):
    usage = {"parameters": parameters, "parameter_bytes": 4 * parameters, "macs_window": 50 * parameters,
             "macs_tick": parameters, "cycles": [parameters, 2 * parameters, 4 * parameters],
             "ram_bytes": 8 * parameters, "flash_bytes": 6 * parameters}  # fmt: skip
    scores = {"10": {"mae": mae, "composite": 1.4 * mae}}
    return {"name": name, "run": name, "recipe": recipe, "number_format": "float32", "label": "float32",
            "resource_usage": usage, "scores": scores, "before": scores, "fits": fits, "error": mae / 4.0,
            "over": {} if fits else {"cycles": [4 * parameters, 30_000]}}  # fmt: skip


def content(chosen=1):
    rows = [
        row("teacher", "teacher", 4.0, 20_000, False),
        row("student <b>", "distilled", 4.2, 5_000, chosen is not None),
    ]
    opening = {"test_set": "test", "judged": ["teacher"], "why": "chosen", "time": "2026-03-04"}
    score = {"10": {"mae": 4.1, "composite": 5.8}}
    chosen_score = {"10": {"mae": 4.4, "composite": 6.0}}
    test = {"name": "test", "opened": "2026-03-04", "scores": {"teacher": score, "chosen": chosen_score},
            "error": 1.07, "seen_before": True, "openings": [opening, opening]}  # fmt: skip
    return {
        "schema": 2, "rows": rows, "teacher": rows[0], "front": [0, 1], "chosen": chosen, "unit": "mm/s",
        "task": {"horizons": [10], "rate_hz": 100.0}, "budget": {"name": "a small controller", "cycles": 30_000,
                                                                 "parameter_bytes": 100_000},
        "held_out_test": {} if chosen is None else test, "recordings": {"train": 6, "validation": 3, "test": 1},
        "notes": ["A note."],
    }  # fmt: skip


@pytest.mark.parametrize(("chosen", "name"), [(1, "compression"), (None, "compression_nothing_fits")])
def test_the_text_of_the_page(tmp_path, chosen, name):
    folder = tmp_path / "smaller"
    write_json(folder / "compression.json", content(chosen))
    check_text(write_compression_page(folder, pictures=False).read_text(encoding="utf-8"), name)
