"""Versions of the site beside each other."""

import json

import pytest

from edp_site.built import problems_of
from edp_site.stage import stage
from edp_site.versions import add_version, checked_name, order_of


def built(folder, text="x"):
    folder.mkdir(parents=True)
    page = f"<html lang='en'><head><title>t</title></head><body><main><h1>{text}</h1></main></body></html>"
    (folder / "index.html").write_text(page)
    return folder


def test_versions_stand_beside_each_other_and_the_newest_comes_first(tmp_path):
    site = tmp_path / "site"
    built(site / "old")  # a site without versions, whose pages belong to none
    assert add_version(built(tmp_path / "a"), site, "0.9") == ["0.9"]
    assert not (site / "old").exists()
    assert add_version(built(tmp_path / "b"), site, "0.10") == ["0.10", "0.9"]
    assert add_version(built(tmp_path / "c", "anew"), site, "0.9") == ["0.10", "0.9"]
    assert "anew" in (site / "0.9" / "index.html").read_text()
    listed = (site / "versions.js").read_text().removeprefix("window.edpVersions = ").rstrip(";\n")
    assert json.loads(listed) == ["0.10", "0.9"]
    assert "url=0.10/index.html" in (site / "index.html").read_text()
    assert problems_of(site) == []


def test_names_of_versions_are_bounded_and_sorted():
    assert sorted(["1.0", "0.10", "1.0rc1", "0.9", "1.0.1"], key=order_of) == ["0.9", "0.10", "1.0rc1", "1.0", "1.0.1"]
    for name in ("", "..", "../x", "a/b", "-1", "x" * 40, "a b"):
        with pytest.raises(ValueError, match="must hold"):
            checked_name(name)


def test_pages_of_a_version_know_it(tmp_path):
    stage(tmp_path / "one", version="0.1")
    script = (tmp_path / "one" / "pages" / "theme" / "site.js").read_text(encoding="utf-8")
    assert script.startswith('window.edpVersion = "0.1";')
    stage(tmp_path / "two")
    assert not (tmp_path / "two" / "pages" / "theme" / "site.js").read_text(encoding="utf-8").startswith("window")
