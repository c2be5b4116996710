"""``edp data store``: logs read once into a data-set store that every command takes in their place."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, err, listing, out, table
from edp.cli.inspect import FAULTY
from edp.cli.options import ClusterOption, MapOption, OpenOption, RepairOption, source_of, workers_of
from edp.cli.progress import show_progress
from edp.errors import count_of
from edp.wording import number

if TYPE_CHECKING:
    from edp.logs.store import StoreIndex

MAX_REFUSED = 20
"""Refused logs that are printed; the index has all of them."""

app = typer.Typer(
    name="store",
    help="Read logs once into a data-set store, which commands take in place of the logs and do not load into memory.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@app.command("build")
def build(
    data: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOGS...",
            help="Logs and folders of logs; or one data-set file (.toml), or one address: s3://, gs://, az://.",
        ),
    ],
    folder: Annotated[
        Path, typer.Option("--out", help="Folder of the store; an existing one is continued or added to.")
    ],
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    workers: Annotated[
        int, typer.Option(min=0, max=256, help="Processes that read side by side; 0: one for each core.")
    ] = 0,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Read logs into a store: SI units on a uniform grid, as every command would read them.

    Stopped and given again it goes on. Logs that are in the store and were not changed are not read again, changed ones
    replace what was stored of them. Logs that cannot be read are listed, and the exit code is then 3.

    Example: `edp data store build logs/ --map mine.toml --out store`, then `edp train store --out runs/first`
    """
    source = source_of(data, signal_map, repair)
    with show_progress("store", as_json) as progress:
        index = source.store(folder, workers_of(workers, cluster, open_cluster, usual=0), progress)
    _show(index, folder, as_json)
    if index.refused:
        err.print(
            f"{count_of(len(index.refused), 'log')} left out of the store: mend what is wrong and give the same "
            "command again"
        )
        raise typer.Exit(FAULTY)


@app.command("verify")
def verify(
    folder: Annotated[Path, typer.Argument(help="Folder of a store.")],
    as_json: JsonFlag = False,
) -> None:
    """Compare every sample of a store with its hash.

    After a store was copied, commands do that each time they open it; this notes that the copy is sound.

    Example: `edp data store verify store`
    """
    from edp.logs.store import check_store

    _show(check_store(folder), folder, as_json)


def _show(index: StoreIndex, folder: Path, as_json: bool) -> None:
    size = sum(file.bytes for file in index.files)
    channels = sorted({channel.name for channels in index.lists for channel in channels})
    facts = {
        "store": str(folder),
        "recordings": len(index.recordings),
        "hours": index.hours(),
        "bytes": size,
        "files": len(index.files),
        "channels": channels,
        "refused": [{"log": refused.log, "why": refused.why} for refused in index.refused],
    }

    def show() -> None:
        rows = [
            ("recordings", f"{len(index.recordings):,}"),
            ("hours", number(index.hours(), 2)),
            ("channels", f"{len(channels)}"),
            ("size", f"{number(size / 1e6, 1)} MB in {count_of(len(index.files), 'file')}"),
        ]
        table(f"store {folder}", ["", ""], rows)
        if index.refused:
            out.print()
            listing("refused", ["log", "why"], [(refused.log, refused.why) for refused in index.refused[:MAX_REFUSED]])
            if len(index.refused) > MAX_REFUSED:
                out.print(f"and {len(index.refused) - MAX_REFUSED} more")
        if index.recordings:
            out.print(f"next: edp data check {folder}; edp train {folder} --out runs/first")

    emit(as_json, facts, show)
