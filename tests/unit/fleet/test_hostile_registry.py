"""Entries of a registry that somebody else wrote: no path in them leads out of it, and no value breaks the list."""

import json

import pytest

from edp.errors import StorageError
from edp.settings.provenance import Provenance
from edp.workflows.fleet.registry import ENTRIES, _data_of, find_entry, lineage, list_registry, read_entry

GOOD, OTHER = "a" * 32, "b" * 32
ENTRY = {
    "schema": 1,
    "id": GOOD,
    "kind": "network",
    "name": "net",
    "label": "hybrid",
    "base": "",
    "data": {},
    "judge": {},
    "added": "2026-01-01",
    "edp": "0.1.0",
}


@pytest.fixture
def registry(tmp_path):
    """A registry below a folder with an entry that does not belong to it."""
    top = tmp_path / "registry"
    (top / ENTRIES).mkdir(parents=True)
    (tmp_path / "secret.json").write_text(json.dumps({**ENTRY, "id": "../../secret"}))
    return top


def write(registry, file, **changes):
    (registry / ENTRIES / f"{file}.json").write_text(json.dumps(ENTRY | changes))


@pytest.mark.parametrize("base", ["../../secret", "/etc/passwd", "a" * 31, "A" * 32, "x\n"])
def test_a_base_that_is_no_identifier_is_damage(registry, base):
    write(registry, GOOD)
    write(registry, OTHER, id=OTHER, base=base)
    entries, damaged = list_registry(registry)
    assert [entry.id for entry in entries] == [GOOD]
    assert len(damaged) == 1
    assert "is no identifier" in damaged[0]


def test_an_identifier_that_is_a_path_is_refused(registry):
    with pytest.raises(StorageError, match="is no identifier"):
        read_entry(registry, "../../secret")


@pytest.mark.parametrize(
    "changes", [{"kind": "program"}, {"kind": 5}, {"name": None}, {"data": []}, {"judge": "x"}, {"schema": 2}]
)
def test_other_values_are_damage(registry, changes):
    write(registry, GOOD, **changes)
    assert (list_registry(registry)[0], len(list_registry(registry)[1])) == ([], 1)


def test_a_circle_of_bases_ends(registry):
    write(registry, GOOD, base=OTHER)
    write(registry, OTHER, id=OTHER, name="other", base=GOOD)
    steps = lineage(registry, find_entry(registry, "net"))
    assert [step if isinstance(step, str) else step.id for step in steps] == [OTHER, GOOD]


def test_a_recording_that_is_divided_by_time_is_counted_once():
    parts = {
        "train": {"recordings": 2, "hours": 0.5, "names": ["a[0:60]", "b[0:60]"]},
        "test": {"recordings": 2, "hours": 0.25, "names": ["a[70:100]", "b[70:100]"]},
    }
    nameless = {part: {**held, "names": []} for part, held in parts.items()}
    assert _data_of(Provenance.from_table({"data": parts}, "here"))["recordings"] == 2
    assert _data_of(Provenance.from_table({"data": nameless}, "here"))["recordings"] == 4
