"""The groups in which ``stillpath --help`` shows the commands."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

__all__ = ["GROUPS", "GroupedCommands"]

GROUPS: dict[str, tuple[str, ...]] = {
    "Print": ("compensate", "simulate", "batch", "watch", "remove-advice", "jobs"),
    "Machine": ("machines", "identify", "ring-test", "coupon", "tower", "motor-test", "verify"),
    "Inside Klipper": ("klipper",),
    "Research": ("plan", "trajectories", "design", "track", "loops", "controller", "scan"),
    "Server": (
        *("serve", "scheduler", "worker", "keys", "audit", "printers"),
        *("backup", "restore", "migrate", "warm"),
    ),
}
"""Commands by group, each in the order in which a user needs them."""


class GroupedCommands(TyperGroup):
    """The command line's help, with its commands in groups."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each group with its commands; a command of no group stands in the last one."""
        grouped = {name for names in GROUPS.values() for name in names}
        others = tuple(name for name in self.list_commands(ctx) if name not in grouped)
        width = max(len(name) for name in self.list_commands(ctx))
        for title, names in (*GROUPS.items(), ("Others", others)):
            rows = [
                (name.ljust(width), command.get_short_help_str(formatter.width - 6 - width))
                for name in names
                if (command := self.get_command(ctx, name)) is not None and not command.hidden
            ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
