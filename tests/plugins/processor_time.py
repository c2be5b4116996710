"""Where the processor time of the tests goes: ``pytest --processor-times`` prints it by folder and by file.

Counted is the processor time of the worker and of the child processes that ended during a test, its fixtures
included; what a shared fixture costs therefore stands with the first test that asks for it. The rest of a worker's time
is its start: imports and collection.
"""

from __future__ import annotations

import resource
from collections import defaultdict
from collections.abc import Generator, Iterable
from typing import Any

import pytest

LONGEST = 25
"""Files and tests that are named one by one."""
NAME = "processor_s"
_begun: list[tuple[float, float]] = []
_starts: list[float] = []


def now() -> tuple[float, float]:
    """Processor seconds of this process, and of its children that ended, user and system."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime, children.ru_utime + children.ru_stime


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    """Note the time before the fixtures of a test."""
    _begun[:] = [now()]
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """The report of the teardown is the last of a test; it travels from the worker to the summary."""
    report = yield
    if call.when == "teardown" and _begun:
        own, children = (after - before for before, after in zip(_begun[0], now(), strict=True))
        report.user_properties.append((NAME, (own, children)))
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A worker tells the controller what it took in all."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        output[NAME] = sum(now())


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist, which `-p no:xdist` leaves out
def pytest_testnodedown(node: Any) -> None:
    _starts.append(float(getattr(node, "workeroutput", {}).get(NAME, 0.0)))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Tables of folders, files and tests."""
    spent = {
        report.nodeid: dict(report.user_properties)[NAME]
        for reports in terminalreporter.stats.values()
        for report in reports
        if NAME in dict(getattr(report, "user_properties", ()))
    }
    whole = sum(_starts) or sum(now())
    total = sum(map(sum, spent.values()))
    terminalreporter.section("processor time")
    for name, depth in (("folder", 2), ("file", None)):
        sums: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for test, parts in spent.items():
            file = test.partition("::")[0]
            sums["/".join(file.split("/")[:depth])].append(parts)
        _table(terminalreporter, name, {one: (len(all_), *_sum(all_)) for one, all_ in sums.items()})
    _table(terminalreporter, "test", {test: (1, *parts) for test, parts in spent.items()})
    terminalreporter.write_line(f"starts of workers (imports, collection) {whole - total:.1f} s, all {whole:.1f} s")


def _sum(parts: Iterable[tuple[float, float]]) -> tuple[float, float]:
    own, children = zip(*parts, strict=True)
    return sum(own), sum(children)


def _table(reporter: Any, name: str, rows: dict[str, tuple[int, float, float]]) -> None:
    reporter.write_line(f"{'all, s':>8} {'children':>8} {'tests':>6}  {name}")
    for one, (count, own, children) in sorted(rows.items(), key=lambda row: -sum(row[1][1:]))[:LONGEST]:
        reporter.write_line(f"{own + children:8.1f} {children:8.1f} {count:6}  {one}")
