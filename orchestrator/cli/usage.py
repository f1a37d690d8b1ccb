"""How commands and groups present their usage. Separate: the program and its groups need it."""

from typing import Any

from typer.core import TyperCommand, TyperGroup


class _PlainUsage:
    """Usage as in a manual: `RUN [FOLDER]` for arguments, and flags without the type of a value."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters with --help; flags and counters show no type."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]  # of the command
        for parameter in parameters:
            if getattr(parameter, "is_flag", False) or getattr(parameter, "count", False):
                parameter.metavar = ""
        return parameters

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The words of the usage line; typer puts required arguments into braces."""
        pieces: list[str] = super().collect_usage_pieces(ctx)  # type: ignore[misc]
        return [piece.replace("{", "").replace("}", "") for piece in pieces]


class Command(_PlainUsage, TyperCommand):
    """A command."""


class Group(_PlainUsage, TyperGroup):
    """A group of commands."""
