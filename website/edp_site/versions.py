"""Several versions of the site side by side: ``python -m edp_site.versions BUILT SITE VERSION``.

Each version is a folder of the site; ``versions.js`` lists them for the selector in the head of each page, and the
site's first page leads to the newest. All of it works from files, too: nothing is fetched.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

LIST, FIRST = "versions.js", "index.html"
MARK = "edp-version.txt"
"""Says which folder of a site is a version, and of what name."""
_NAME = re.compile(r"[0-9A-Za-z][0-9A-Za-z._+-]{0,31}")
_FIRST_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="refresh" content="0; url={name}/index.html">
<title>Excavator Dynamics Predictor</title>
</head>
<body><main><h1>Excavator Dynamics Predictor</h1>
<p><a href="{name}/index.html">Documentation of version {name}</a></p></main></body>
</html>
"""


def checked_name(name: str) -> str:
    """Return the name of a version, which is the name of its folder.

    Raises:
        ValueError: it is none.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"version {name!r}: letters, digits and ._+- must hold, at most 32, such as 0.1")
    return name


def order_of(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts 0.10 after 0.9, and 1.0rc1 before 1.0."""
    parts = re.findall(r"\d+|[A-Za-z]+", name)
    return (*((1, int(part), "") if part.isdigit() else (-1, 0, part) for part in parts), (0, 0, ""))


def add_version(built: Path, site: Path, name: str) -> list[str]:
    """Move a built site into its folder, and list all versions that are there.

    Args:
        built: what the builder wrote; it is moved.
        site: folder of all versions; one that holds a site without versions is emptied first.
        name: of the version; a version of the same name is replaced.

    Returns:
        Names of all versions, the newest first.
    """
    folder = site / checked_name(name)
    if not (site / LIST).exists():
        shutil.rmtree(site, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)
    site.mkdir(parents=True, exist_ok=True)
    shutil.move(built, folder)
    (folder / MARK).write_text(f"{name}\n", encoding="utf-8")
    names = sorted((mark.parent.name for mark in site.glob(f"*/{MARK}")), key=order_of, reverse=True)
    (site / LIST).write_text(f"window.edpVersions = {json.dumps(names)};\n", encoding="utf-8")
    (site / FIRST).write_text(_FIRST_PAGE.format(name=names[0]), encoding="utf-8")
    return names


def main() -> int:
    """See the module's text."""
    built, site, name = sys.argv[1:]
    print("versions: " + ", ".join(add_version(Path(built), Path(site), name)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
