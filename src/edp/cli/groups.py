"""Groups of commands: the root, which reads earlier names, and groups that also take data directly."""

from __future__ import annotations

from typing import Any, ClassVar

from typer.core import TyperGroup

from edp.cli.console import err
from edp.cli.names import rewrite

RUN = "run"
"""Command of a group that takes data directly."""


class Root(TyperGroup):
    """`edp` itself: earlier names of commands and options are replaced before a command line is parsed."""

    order: ClassVar[tuple[str, ...]] = ()
    """Names of commands and groups in the order of `edp --help`."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of commands and groups in the order of their panels."""
        return sorted(super().list_commands(ctx), key=self.order.index)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Replace earlier names, and print one line on standard error for each."""
        rewritten = rewrite(args)
        for notice in rewritten.notices:
            err.print(f"note: {notice}; the earlier name will be removed in the next release")
        return super().parse_args(ctx, rewritten.words)


class RunByDefault(TyperGroup):
    """Group that also takes data directly: `edp search DATA ...` is `edp search run DATA ...`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the named command, or `run`."""
        if args and args[0] not in self.commands:
            args = [RUN, *args]
        return super().resolve_command(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help of the group, followed by the help of `run`, whose options the group takes."""
        super().format_help(ctx, formatter)
        run = self.commands[RUN]
        run.format_help(run.context_class(run, info_name=RUN, parent=ctx), formatter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse options before the data as options of `run`."""
        if args and args[0].startswith("-") and args[0] not in ("--help", "-h"):
            args = [RUN, *args]
        return super().parse_args(ctx, args)
