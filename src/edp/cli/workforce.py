"""Options of commands that many processes or computers can do together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from edp.jobs import Workforce

WorkersOption = Annotated[int, typer.Option(min=0, max=256, help="Processes side by side; 0: one for each core.")]
ClusterOption = Annotated[
    str,
    typer.Option(help="Address of a Ray cluster that does the work, or auto; all paths must lead to the same there."),
]
OpenOption = Annotated[
    bool,
    typer.Option(
        "--open-cluster", help="Accept a cluster without a token, on which anyone who can reach it can run code."
    ),
]


def workforce_of(workers: int, cluster: str, open_cluster: bool, usual: int = 1) -> Workforce:
    """Who does the work.

    Args:
        workers: as given.
        cluster: as given.
        open_cluster: as given.
        usual: number of workers where the option is left out; not refused beside a cluster.
    """
    from edp.jobs import Workforce

    chosen = 1 if cluster and workers == usual else workers
    return Workforce(workers=chosen, cluster=cluster, open_cluster=open_cluster)
