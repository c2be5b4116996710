"""The report of a transfer from what lies on disk: the thesis's own Table 4.10, odd names, nothing gained."""

import numpy as np
import pytest
from browser import check_page
from page_text import check_text
from safetensors.numpy import save_file

from edp.errors import StorageError
from edp.report import read_transfer, write_transfer_page
from edp.report.transfer import facts as transfer_facts
from edp.report.transfer.page import build_transfer_page
from edp.storage import write_json

pytestmark = pytest.mark.long

EVIL = "</script><script>alert(1)</script><b>&"
PRINTED = {
    "direct": [(78, 6.6, 0.7862, 16.2, 28.1), (167, 8.3, 0.9476, 27.0, 51.9), (236, 9.1, 0.9097, 32.1, 51.7)],
    "two_phase": [(10, 1.7, 0.9737, 6.2, 13.0), (30, 3.1, 0.9906, 10.8, 22.2), (59, 4.0, 0.9774, 15.4, 31.2)],
}
"""Table 4.10 in mm/s: MSE, MAE, R2, P95, P99 of boom, arm and bucket."""
KEYS = ("mse", "mae", "r2", "p95", "p99")
CYLINDERS = ("Boom", "Arm", "Bucket")


def scores(rows):
    found = {
        name: dict(zip(KEYS, row, strict=True)) | {"bias": 0.1 * row[1], "skew": -0.5}
        for name, row in zip(CYLINDERS, rows, strict=True)
    }
    mean = {key: float(np.mean([row[key] for row in found.values()])) for key in (*KEYS, "bias", "skew")}
    return {"10": found | {"mean": mean}}


def content():
    edges, shares = np.linspace(-10, 10, 6).tolist(), [0.1, 0.2, 0.4, 0.2, 0.1]
    return {
        "schema": 2,
        "method": "two_phase",
        "before": "direct",
        "network": "hybrid",
        "task": {"horizons": [10], "rate_hz": 100.0, "skip": 50},
        "targets": [{"name": name, "description": name, "unit": "mm/s", "factor": 1e3} for name in CYLINDERS],
        "data": {"recordings": 2, "minutes": {"train": 30.0, "validation": 7.0, "test": 8.0}},
        "methods": {
            name: {
                "label": {"direct": "Standard", "two_phase": "Fine-Tuned"}[name],
                "learned": 0 if name == "direct" else 84_292,
                "weights": None,
                "domains": {"target": scores(rows), "source": scores(PRINTED["direct"])},
            }
            for name, rows in PRINTED.items()
        },
        "distributions": {
            "10": {name: {"edges": edges, "shares": dict.fromkeys(PRINTED, shares)} for name in CYLINDERS}
        },
        "notes": [],
    }


@pytest.fixture
def folder(tmp_path):
    """A folder with a transfer; called with a changed content it is written anew."""

    def write(held, name="drive"):
        write_json(tmp_path / "transfer.json", held)
        course = np.sin(np.arange(200) / 20).astype(np.float32).reshape(-1, 1, 1) * np.ones((1, 1, 3), np.float32)
        shown = {f"{name}/{key}": course.copy() for key in ("truth", "direct", "two_phase")}
        save_file(shown | {f"{name}/start": np.zeros(1, np.float32)}, tmp_path / "transfer_predictions.safetensors")
        return tmp_path

    return write


def test_the_table_has_the_form_and_figures_of_the_thesis(folder):
    facts = read_transfer(folder(content()))
    sheet = transfer_facts.pair_table(facts, "10")
    assert [column.heading for column in sheet.columns[:7]] == [
        "Model variant",
        "Target",
        "MSE",
        "MAE",
        "R²",
        "P95",
        "P99",
    ]
    texts = sheet.texts()
    assert texts[0][:7] == ("Standard", "Boom", "78.0", "6.60", "0.7862", "16.20", "28.1")
    assert texts[5][:7] == ("Fine-Tuned", "Bucket", "59.0", "4.00", "0.9774", "15.40", "31.2")
    assert sheet.marked == {3, 4, 5}
    assert facts.gain("10") == pytest.approx(1 - 8.8 / 24.0)
    assert "Fine-Tuned: 63 % less error than direct transfer, 2.93 instead of 8" in transfer_facts.headline(facts)
    lines = " ".join(transfer_facts.verdict(facts))
    assert "R² is 0.9737 (Boom), 0.9906 (Arm) and 0.9774 (Bucket)." in lines
    assert "Boom, Arm and Bucket have a bias above 5.0 % of their MAE" in lines


def test_the_page_its_tables_and_pictures_are_written(folder):
    place = folder(content())
    page = write_transfer_page(place)
    text = page.read_text(encoding="utf-8")
    assert "://" not in text.split("<script>")[0]
    for name in ("pair_k10.csv", "pair_k10.md", "methods_k10.csv", "methods_k10.md"):
        assert (place / "tables" / name).is_file()
    for name in ("prediction_direct", "prediction_two_phase", "errors_direct", "errors_two_phase"):
        for suffix in ("svg", "png"):
            assert (place / "pictures" / f"{name}_k10.{suffix}").is_file()


def test_names_from_files_end_no_element(folder):
    held = content()
    held["methods"]["direct"]["label"] = held["targets"][0]["description"] = EVIL
    held["notes"] = [EVIL]
    facts = read_transfer(folder(held, EVIL.replace("/", "")))
    text = build_transfer_page(facts).html()
    assert "<script>alert" not in text
    assert "<b>&" not in text.replace("<b>" + facts.folder.name, "")


def test_what_is_not_there_is_not_shown(folder):
    held = content()
    for row in held["methods"].values():
        del row["domains"]["source"]
        for name in (*CYLINDERS, "mean"):
            row["domains"]["target"]["10"][name]["r2"] = None
    held["methods"]["two_phase"]["domains"] = held["methods"]["direct"]["domains"]
    facts = read_transfer(folder(held))
    assert transfer_facts.headline(facts).find("No epoch was better on the validation part") > 0
    assert "source" not in " ".join(transfer_facts.verdict(facts))
    assert "MAE on the source" not in [c.heading for c in transfer_facts.method_table(facts, "10").columns]
    assert "On the source" not in build_transfer_page(facts).html()


def test_a_better_rival_is_named(folder):
    held = content()
    held["methods"]["full"] = {
        "label": "One rate",
        "learned": 84_292,
        "weights": None,
        "domains": held["methods"]["two_phase"]["domains"],
    }
    held["methods"]["two_phase"] |= {
        "domains": {"target": scores(PRINTED["direct"]), "source": scores(PRINTED["direct"])}
    }
    assert "One rate has less: 2.93 mm/s." in transfer_facts.verdict(read_transfer(folder(held)))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda place: (place / "transfer.json").unlink(), "holds no transfer.json"),
        (lambda place: (place / "transfer.json").write_text('{"schema": 9}'), "another version"),
        (lambda place: (place / "transfer_predictions.safetensors").write_bytes(b"cut"), "cannot be read"),
        (lambda place: (place / "transfer_predictions.safetensors").unlink(), "cannot be read"),
    ],
)
def test_what_cannot_be_read_is_refused(folder, spoil, reason):
    place = folder(content())
    spoil(place)
    with pytest.raises(StorageError, match=reason):
        read_transfer(place)


def test_the_text_of_the_page(folder):
    page = write_transfer_page(folder(content()), pictures=False)
    check_text(page.read_text(encoding="utf-8").replace(page.parent.name, "logs"), "transfer")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, folder):
    check_page(browser, write_transfer_page(folder(content())), "transfer", CYLINDERS)
