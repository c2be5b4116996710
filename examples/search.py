"""A network searched for, and what the search says of it: ``python examples/search.py DATA STUDY``."""

import sys

from edp.logs.source import DataSource
from edp.workflows.search.plan import load_plan
from edp.workflows.search.runner import Resources, run_search


def main(data: str, study: str, *changes: str) -> None:
    plan = load_plan(preset="quick", overrides=changes)
    found = run_search(DataSource.from_path(data), plan, study, Resources(count=2))
    for decision in found.context.decided.values():
        print(decision.phase, *decision.sentences, sep="\n  ")
    print("settings of the winner:", found.teacher)


if __name__ == "__main__":
    main(*sys.argv[1:])
