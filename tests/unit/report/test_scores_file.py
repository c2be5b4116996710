"""A ``scores.json`` that was changed by hand gives one error that names the value, or the page; never a traceback."""

import copy
import json

import pytest

from edp.errors import EdpError, StorageError
from edp.evaluation.scores_file import ScoresFile
from edp.report.run.facts import read_facts
from edp.report.run.page import build_run_page
from edp.storage import write_json

pytestmark = pytest.mark.long

OTHERS = (None, 10**400, "x", {"x": 5}, {"10": None})
"""What a value may be changed to."""


def paths(value, before=()):
    """Where values lie; of alike entries (targets, horizons, recordings, bins, metrics) the last one."""
    yield before
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    named = len(before) == 0 or (len(before) == 2 and before[0] == "models") or before[:1] in (("task",), ("targets",))
    for key in keys if named or len(keys) < 2 else ("network",) if before == ("models",) else keys[-1:]:
        yield from paths(value[key], (*before, key))


def changed(scores, path, other):
    content = copy.deepcopy(scores)
    if not path:
        return other
    at = content
    for key in path[:-1]:
        at = at[key]
    if other is KeyError:
        del at[path[-1]]
    else:
        at[path[-1]] = other
    return content


@pytest.fixture
def drawn(make_run):
    """A run without predictions and history: what its page shows is the scores."""
    folder = make_run(recordings=2, samples=300)
    for name in ("predictions.safetensors", "history.jsonl", "footprint.json"):
        (folder / name).unlink(missing_ok=True)
    return folder


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_any_change_is_one_error_or_a_page(drawn, step):
    """Each value is changed in every `step`-th way, each value from another one on."""
    file = drawn / "scores.json"
    scores = json.loads(file.read_text())
    scores["models"]["network"]["intervals"] = {
        "10": [{"coverage": 0.9, "covered": {"mean": 0.88}, "width": {"mean": 3.0}}]
    }
    scores["models"]["network"]["weighted_interval_score"] = {"10": {"mean": 2.0}}
    messages = []
    for number, path in enumerate(paths(scores)):
        for other in (KeyError, *OTHERS)[number % step :: step]:
            if path == () and other is KeyError:
                continue
            content = changed(scores, path, other)
            write_json(file, content) if isinstance(content, dict) else file.write_text(json.dumps(content))
            try:
                build_run_page(read_facts(drawn)).html()
            except EdpError as error:
                messages.append(str(error))
            except Exception as error:
                raise AssertionError(f"{path} changed to {other!r}") from error
    assert len(messages) > 100 / step
    assert all("scores.json" in message for message in messages)


@pytest.mark.parametrize(
    ("path", "other", "message"),
    [
        (
            ("models", "network", "overall", "10", "mean", "mae"),
            "low",
            r"models\.network\.overall\.10\.mean\.mae = 'low': a text is no number",
        ),
        (("models", "network"), [], r"models\.network: expected a table, got \[\]"),
        (("models", "network", "overall"), KeyError, r"'models\.network\.overall' is missing"),
        (("targets",), {"name": "y"}, "targets = .*: a list must hold"),
        (("targets", 0, "factor"), 0, r"targets\[0\]: .*factor"),
        (("targets", 0, "faktor"), 1.0, "unknown key 'targets.*faktor'; did you mean 'factor'"),
        (("task", "horizons", 0), 1.5, r"task\.horizons = .*: an integer"),
    ],
)
def test_the_message_names_the_value_and_what_to_do(drawn, path, other, message):
    file = drawn / "scores.json"
    write_json(file, changed(json.loads(file.read_text()), path, other))
    with pytest.raises(StorageError, match=message) as caught:
        ScoresFile.from_file(file)
    assert "remove it and run edp evaluate" in str(caught.value)
