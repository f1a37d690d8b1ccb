"""Where the files of deploy/ are, the shell that is in them, and programs that record how they are called."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
import yaml
from typer.main import get_command

from panolog.orchestrator.cli import app

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"


def load(name: str) -> Any:
    """A YAML file of deploy/ with one document."""
    return yaml.safe_load((DEPLOY / name).read_text())


def load_all(name: str) -> list[Any]:
    """A YAML file of deploy/ with several."""
    return list(yaml.safe_load_all((DEPLOY / name).read_text()))


def commands(config: Any) -> Iterator[str]:
    """Every shell command of a Ray cluster's configuration."""
    for key, value in config.items():
        if key.endswith("_commands"):
            yield from value


def programs(folder: Path, texts: Mapping[str, str]) -> None:
    """Writes scripts by their names."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)


def parsed(words: Sequence[str]) -> dict[str, Any]:
    """The parameters of a command of panolog. Raises what typer does where it does not take these words."""
    command, rest, name, parent = get_command(app.app), list(words), "panolog", None
    while isinstance(command, typer.core.TyperGroup):
        parent = typer.Context(command, info_name=name, parent=parent)
        name = rest.pop(0)
        command = command.commands[name]
    return command.make_context(name, rest, parent=parent).params
