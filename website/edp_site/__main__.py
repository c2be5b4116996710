"""``python -m edp_site OUT [--demo FOLDER]``: write the pages of the site and the builder's settings."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from edp_site.links import broken_links
from edp_site.stage import stage
from edp_site.versions import checked_name


def main() -> int:
    """Stage the site and check the links of its pages; 1 where one leads nowhere."""
    parser = argparse.ArgumentParser(description="Write the pages of the documentation site.")
    parser.add_argument("out", type=Path, help="folder that is emptied first")
    parser.add_argument("--demo", type=Path, default=None, help="folder of `make demo`, for the gallery")
    parser.add_argument("--version", type=checked_name, default=None, help="that the pages are of; see versions.py")
    given = parser.parse_args()
    pages = stage(given.out, given.demo, version=given.version)
    problems = broken_links(pages, given.out / "pages")
    print("\n".join([*problems, f"{len(pages)} pages, {len(problems)} broken links"]))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
