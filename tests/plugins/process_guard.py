"""`make check` starts no process: tests that do are marked `processes` and left out, and a forgotten one fails.

A test is marked by hand, by its folder, or by a fixture that starts processes. The guard is an audit hook of Python
(`sys.addaudithook`), which sees every way to start a process but `_posixsubprocess.fork_exec` of `multiprocessing`;
that one is replaced.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NoReturn

import pytest

HERE = Path(__file__).parents[1]
FOLDERS = ("examples", "export", "fuzz", "golden", "parity", "properties", "security", "unit/cli")
"""Whose tests run compilers, commands and workers, or belong to no quick check."""
FIXTURES = frozenset({"edp", "lever_sessions", "six_sessions"})
"""Reading a log starts the sandbox of the readers, and all of these read logs."""
FILES = frozenset(
    (
        *("pretraining/test_pretraining", "report/test_animation", "search/test_cluster", "search/test_kill_storm"),
        *("search/test_ledger", "search/test_local_pool", "test_logs_errors", "test_logs_formats", "test_logs_mdf"),
        *("test_logs_octave", "test_logs_parquet", "test_logs_rosbag", "test_logs_time_and_quality", "test_logs_truth"),
        *("test_workflow", "test_trials", "transfer/test_checks", "transfer/test_finetune", "transfer/test_centring"),
        *("test_sim_limit", "test_sim_recordings", "test_front_door", "test_auto", "test_logs_shared_data"),
        *("test_auto_odd_data", "twin/test_continue_twin", "fleet/test_commands", "fleet/test_cluster_commands"),
        *("pretraining/test_pretraining_units", "pretraining/test_fleet_models", "transfer/test_finetune_units"),
    )
)
"""Of ``tests/unit``: whose tests read logs or start workers."""
NAMES = (
    *("boosted_trees", "test_data_set_tells_repeats_and_a_channel", "test_nothing_but_a_proposal_is_a_page_too"),
    *("test_inverse_kinematics_undo", "test_a_family_takes_the_place_of_the_file", "test_closed_loops_give_the_same"),
    *("test_a_process_killed_while_it_writes", "test_films", "test_the_contracts_need_no_test_runner"),
)
"""How single tests begin, or what stands in their name, where the rest of the file starts nothing."""
TRAINING = frozenset(
    (
        *(
            "test_training_resume",
            "test_training_fit",
            "test_training_parts",
            "test_search_phases",
            "test_search_study",
        ),
        *(
            "test_bagging",
            "test_context",
            "test_search_rungs",
            "test_starting_channels",
            "test_distillation",
            "test_discriminative",
            "test_qat",
            "test_ridge_start",
        ),
        *("report/study/test_study_page", "screening/test_screening_figures", "stats/test_null_calibration"),
        *("screening/test_screening_verdicts", "report/study/test_study_in_notebook", "report/test_report_page"),
        "report/test_report_coverage",
        *(
            "report/test_screening_page",
            "report/test_transfer_page",
            "report/test_scores_file",
            "test_compress_search",
            "test_downsizing",
        ),
    )
)
"""Of ``tests/unit``: whose tests train networks or draw pages for seconds each."""
EVENTS = frozenset(
    ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn", "os.system", "os.exec", "pty.spawn")
)
_watched: list[bool] = []
_installed: list[bool] = []


class ProcessStartedError(BaseException):
    """A test of the quick check starts a process; a base exception, so that no test takes it for a result."""


def starts_processes(item: pytest.Item) -> bool:
    """Whether a test's folder or one of its fixtures starts processes."""
    place = place_of(item)
    of_folder = _in_folders(place) or _in_unit(place, FILES)
    of_name = any(name in item.name for name in NAMES)
    return of_folder or of_name or bool(FIXTURES & set(getattr(item, "fixturenames", ())))


def takes_long(item: pytest.Item) -> bool:
    """Whether a test trains networks for seconds: none of the quick check either."""
    return _in_unit(place_of(item), TRAINING)


def leaves_out(path: Path) -> bool:
    """Whether no test of a file belongs to the quick check: it need not be imported, nor what it imports."""
    place = path.relative_to(HERE).as_posix() if path.is_relative_to(HERE) and path.suffix == ".py" else ""
    return _in_folders(place) or _in_unit(place, FILES | TRAINING)


def _in_folders(place: str) -> bool:
    return place.startswith(tuple(f"{folder}/" for folder in (*FOLDERS, "unit/api"))) and not place.endswith(
        "conftest.py"
    )


def place_of(item: pytest.Item) -> str:
    """Of a test's file below `tests`; empty where it lies elsewhere."""
    return _place_of(item.path)


@cache  # a file has thousands of tests
def _place_of(path: Path) -> str:
    return path.relative_to(HERE).as_posix() if path.is_relative_to(HERE) else ""


def _in_unit(place: str, names: frozenset[str]) -> bool:
    return place.removeprefix("unit/").removesuffix(".py") in names


def install() -> None:
    """Put the guard in place; it acts inside `watching` only, since pytest itself starts workers."""
    if _installed:
        return
    _installed.append(True)
    # Bound as defaults: the hook outlives this module's names when Python ends.
    sys.addaudithook(lambda event, _, events=EVENTS, on=_watched: _refuse(event) if on and event in events else None)
    if sys.platform != "win32":
        import _posixsubprocess

        plain = _posixsubprocess.fork_exec
        _posixsubprocess.fork_exec = lambda *args: _refuse("fork_exec") if _watched else plain(*args)


def _refuse(event: str) -> NoReturn:
    raise ProcessStartedError(f"{event}: `make check` starts no process; mark this test with pytest.mark.processes")


@contextlib.contextmanager
def watching() -> Iterator[None]:
    """While a test runs, with its fixtures."""
    _watched.append(True)
    try:
        yield
    finally:
        _watched.pop()
