"""How commands and groups present their usage, and how arguments and options are declared."""

import re
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from panolog.scene.errors import StoreError
from panolog.scene.stores.url import PROTOCOLS, is_url

# What takes URLs of object stores.
_RUNS = ("run", "resume", "status", "events", "report", "export", "doctor", "scene info", "scene check")
_STORES = (*_RUNS, "clean", *(f"cluster {name}" for name in ("submit", "resume", "status", "stop")))


# What typer says of a value, with the words of its library, and the same for people.
_PLAIN = (
    (r"Value error, ", ""),
    (r"Input should be a valid integer.*", "write a whole number"),
    (r"Input should be a valid number.*", "write a number"),
    (r"Input should be ", "must be "),
)


def argument(metavar: str, text: str, **more: Any) -> Any:
    """An argument of a command. Args: text, its help; more, as typer's."""
    return typer.Argument(metavar=metavar, help=text, **more)


def option(metavar: str, text: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """An option with a value. Args: text, its help; names, by default its own; panel of the help."""
    return typer.Option(*names, metavar=metavar, help=text, rich_help_panel=panel, **more)


def flag(text: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """An option without a value. Args: as `option`."""
    return typer.Option(*names, help=text, rich_help_panel=panel, **more)


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

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parses the words. Raises StoreError for the URL of a store where the command reads folders only."""
        name = ctx.command_path.partition(" ")[2]  # after that of the program
        if name not in _STORES:
            for word in args:
                value = word.partition("=")[2] if word.startswith("--") and "=" in word else word
                protocol = value.partition("://")[0].lower()
                if is_url(value) and protocol in PROTOCOLS:
                    raise StoreError(
                        f"{protocol}://…: `panolog {name}` takes files and folders of this machine only;"
                        " docs/storage.md has the commands that take URLs"
                    )
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            for words, plain in _PLAIN:
                error.message = re.sub(f"^{words}", plain, error.message)
            raise


class Group(_PlainUsage, TyperGroup):
    """A group of commands."""
