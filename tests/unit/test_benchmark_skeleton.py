"""What every benchmark shares: arguments, a working folder, kept results, and a clean end where a part is missing."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
SCRIPTS = [path for path in sorted(FOLDER.glob("*.py")) if "__main__" in path.read_text(encoding="utf-8")]


@pytest.fixture
def common(tmp_path, monkeypatch):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        import common

        monkeypatch.setattr(common, "RESULTS", tmp_path / "results")
        yield common
        sys.modules.pop("common", None)


def printed(capsys):
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_has_the_shared_skeleton(path):
    text = path.read_text(encoding="utf-8")
    # The sessions of the monitor's benchmark are data, and the verdicts are names of results: both measure nothing.
    assert "\n@benchmark(" in text or path.stem in ("monitor_sessions", "verdicts")
    assert text.count('if __name__ == "__main__":') == 1


IMPORT_ALL = """
import importlib, sys
sys.path.insert(0, sys.argv[1])
for name in sys.argv[2:]:
    try:
        assert callable(importlib.import_module(name).main)
    except Exception as error:
        print(f"{name}: {error!r}")
"""


@pytest.mark.processes
def test_every_script_finds_what_it_imports():
    """Nobody runs every benchmark after every change; a name that moved is noticed here.

    In a process of its own: scripts register parts, which is done once in a process.
    """
    call = [sys.executable, "-c", IMPORT_ALL, str(FOLDER), *(path.stem for path in SCRIPTS)]
    done = subprocess.run(call, capture_output=True, text=True, check=True)
    assert done.stdout == ""


@pytest.mark.processes
def test_the_short_form_is_written_only_where_it_is_asked_for(common, tmp_path, capsys):
    @common.benchmark()
    def main(bench):
        bench.check("half of it", 1.0, 2.0, "<= 0.5", "mm")
        return {"quick": bench.quick}

    main(["--quick"])
    assert not (tmp_path / "results").exists()
    assert printed(capsys)["target"] == 1.0
    main(["--quick", "--seed", "3", "--out", str(tmp_path / "out")])
    main([])
    for folder, quick in (("out", True), ("results", False)):
        result = json.loads((tmp_path / folder / f"{Path(__file__).stem}.json").read_text())
        assert result["details"] == {"quick": quick}
        assert [one["title"] for one in result["verdicts"]] == ["half of it"]
        assert result["seed"] == (3 if quick else 0)


@pytest.mark.processes
def test_figures_that_are_no_numbers_are_kept_as_null(common, tmp_path):
    """JSON has no infinity and no NaN, and a run of hours must not end with a message about them."""

    @common.benchmark(common.WORK)
    def main(bench):
        found = bench.part("part", lambda: {"none": float("nan"), "whole": np.int64(3)})
        assert found["none"] is None
        bench.check("of nothing", 1.0, 0.0, "<= 1", "mm")
        return {"rows": [(np.float32(0.5), float("inf"), "text")], "part": found["whole"]}

    main(["--out", str(tmp_path), "--work", str(tmp_path)])
    result = json.loads((tmp_path / f"{Path(__file__).stem}.json").read_text())
    assert result["details"] == {"rows": [[0.5, None, "text"]], "part": 3}
    assert result["verdicts"][0]["reference"] is None


def test_a_part_is_read_from_the_working_folder_of_an_earlier_run(common, tmp_path):
    measured = []

    @common.benchmark(common.WORK, common.DATA, common.option("--times", type=int, default=2))
    def main(bench):
        assert bench.data == bench.folder / "data"
        found = bench.part("found", lambda: measured.append(bench.folder) or {"times": bench.options.times})
        assert found["times"] == 5

    main(["--work", str(tmp_path / "work"), "--times", "5"])
    main(["--work", str(tmp_path / "work")])
    main(["--times", "5"])
    assert measured[0] == tmp_path / "work"
    assert len(measured) == 2
    assert not measured[1].exists()


@pytest.mark.processes
def test_several_results_of_one_run_do_not_mix(common, tmp_path):
    @common.benchmark()
    def main(bench):
        for name in ("first", "second"):
            bench.name = name
            bench.check(name, 1.0, 1.0, "<= 1", "mm")
            bench.finish({"part": name})

    main(["--out", str(tmp_path)])
    for name in ("first", "second"):
        result = json.loads((tmp_path / f"{name}.json").read_text())
        assert [one["title"] for one in result["verdicts"]] == [name]


@pytest.mark.parametrize("missing", ["program", "recordings", "anything"])
def test_what_is_missing_ends_a_benchmark_with_one_line(missing, common, tmp_path, monkeypatch, capsys):
    if missing == "program":
        monkeypatch.setattr(shutil, "which", lambda name: None)

    @common.benchmark(common.SHARED, programs=("gcc",) if missing == "program" else ())
    def main(bench):
        raise common.Skipped("anything is not here")

    shared = tmp_path / "nowhere" if missing == "recordings" else tmp_path
    main(["--shared", str(shared)])
    text = capsys.readouterr().out
    assert text.startswith("skipped:")
    assert {"program": "gcc not found", "recordings": "nowhere"}.get(missing, "anything is not here") in text
    assert json.loads(text.splitlines()[-1])["skipped"] is True
