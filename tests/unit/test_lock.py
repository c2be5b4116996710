"""pyproject.toml, constraints.txt and requirements.lock say the same: what is tested is what `make setup` installs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = SETTINGS["project"]
BESIDE = "# Of the extra `cluster` alone"
ADVICE = "call `make lock` and look through what changed"


def pins(text: str) -> dict[str, str]:
    """Versions by canonical name."""
    found = re.findall(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", text, re.MULTILINE)
    return {str(canonicalize_name(name)): version for name, version in found}


LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")
LOCKED = pins(LOCK)
INSTALLED, CLUSTER = map(pins, (ROOT / "constraints.txt").read_text(encoding="utf-8").split(BESIDE))


def required(extra: str) -> dict[str, Requirement]:
    """Requirements of an extra, with those of the extras of this project that it names."""
    found: dict[str, Requirement] = {}
    for line in PROJECT["optional-dependencies"][extra]:
        requirement = Requirement(line)
        if requirement.name == PROJECT["name"]:
            for other in requirement.extras:
                found |= required(other)
        else:
            found[str(canonicalize_name(requirement.name))] = requirement
    return found


def test_the_lock_holds_the_constraints_but_torch_and_the_cluster():
    assert INSTALLED["torch"], "the Makefile takes the version of torch from here"
    assert {name: version for name, version in INSTALLED.items() if name != "torch"} == LOCKED, ADVICE
    assert not set(LOCKED) & set(CLUSTER)


def test_what_the_project_asks_for_is_locked_in_a_version_that_it_takes():
    asked = {str(canonicalize_name(Requirement(line).name)): Requirement(line) for line in PROJECT["dependencies"]}
    for name, requirement in (asked | required("dev")).items():
        assert name in INSTALLED, f"{name}: add its version to constraints.txt, then {ADVICE}"
        assert requirement.specifier.contains(INSTALLED[name]), (name, INSTALLED[name])
    for name, requirement in required("cluster").items():
        assert requirement.specifier.contains(CLUSTER[name]), (name, CLUSTER[name])


@pytest.mark.parametrize("lock", ["requirements.lock", "requirements-docs.lock"])
def test_every_package_of_the_lock_has_hashes(lock):
    text = (ROOT / lock).read_text(encoding="utf-8")
    blocks = re.split(r"\n(?=[A-Za-z])", text.strip())
    assert {block.split("==")[0] for block in blocks} == set(pins(text))
    for block in blocks:
        assert re.fullmatch(r"[^\n]+( \\\n    --hash=sha256:[0-9a-f]{64})+", block), block[:200]


def test_the_builder_of_the_site_is_locked_in_the_pinned_version_and_is_no_package_of_users():
    locked = pins((ROOT / "requirements-docs.lock").read_text(encoding="utf-8"))
    for line in SETTINGS["dependency-groups"]["docs"]:
        requirement = Requirement(line)
        assert str(requirement.specifier) == f"=={locked[str(canonicalize_name(requirement.name))]}", ADVICE
        assert requirement.name == "axe-core-python" or str(canonicalize_name(requirement.name)) not in LOCKED
