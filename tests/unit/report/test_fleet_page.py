"""The page of a fleet in a browser."""

import pytest
from browser import check_page
from fleet_reports import fleet_report
from page_text import check_text

from edp.report.fleet.facts import fleet_facts
from edp.report.fleet.page import build_fleet_page

NAMES = [f"machine_of_the_customer_with_a_long_name_{number:02d}" for number in range(12)]


def machine(number: int) -> dict[str, object]:
    """A machine whose figures grow with its number."""
    spread = 1.0 + 0.05 * number
    return {
        "machine": NAMES[number], "minutes": 30.0, "mae": 0.8 * spread, "persistence": 2.0, "own": number % 2 == 0,
        "by_target": [0.8 * spread, 0.6], "inputs": {"valve": {"mean": 0.1 * number, "std": spread}},
        "drift": {"ratio": 1.0 + 0.1 * number, "t": float(number)}, "alarms": None, "speed": None,
    }  # fmt: skip


def content() -> dict[str, object]:
    return {
        "machines": [*map(machine, range(11)), {"machine": NAMES[11], "failed": "its logs lack the channel valve"}],
        "targets": [{"name": "position", "unit": "mm"}, {"name": "pressure", "unit": "bar"}],
        "horizon": 10, "rate_hz": 100.0, "store": "fleet", "deltas": None, "monitor": None, "edp": "1",
        "network": {"label": "a network", "path": "runs/a", "weights": "0123"},
    }  # fmt: skip


def test_the_text_of_the_page():
    check_text(build_fleet_page(fleet_facts(fleet_report(content()), "rigs")).html(), "fleet")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, tmp_path):
    page = build_fleet_page(fleet_facts(fleet_report(content()), "<b>rigs</b>")).write(tmp_path / "fleet.html")
    check_page(browser, page, "fleet")
