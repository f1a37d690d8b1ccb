"""What a follower is to do, as the command line says it and as its process gets it: on stdin."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from pydantic import TypeAdapter

from panolog.orchestrator.runs.units import positive
from panolog.orchestrator.watch.follower.references import References
from panolog.orchestrator.watch.follower.targets import Target, check_elsewhere, read_targets
from panolog.scene.errors import ConfigError

END = "end"  # what a run's command writes to its follower when it ends; one that is killed does not
LAST_S = 30.0  # for which the last news are delivered, and tried again
STALLED = "PANOLOG_NOTIFY_STALLED"  # minutes without a record after which a run counts as stalled
_STALLED_MIN = 30.0
_PACKAGES = {"mlflow": "mlflow-skinny", "tensorboard": "tensorboard", "wandb": "wandb"}  # by their modules


@dataclass(frozen=True)
class SinkChoice:
    """One sink: its kind, and its URI, folder or project; "" = its default."""

    kind: str  # mlflow, tensorboard or wandb
    place: str = ""


@dataclass(frozen=True)
class Recipients:
    """Whom a follower serves."""

    targets: tuple[Target, ...] = ()
    sinks: tuple[SinkChoice, ...] = ()
    stalled: float = 60 * _STALLED_MIN  # seconds

    def __bool__(self) -> bool:
        """Whether there is anything to do."""
        return bool(self.targets or self.sinks)


def read_recipients(
    notify: Sequence[str], log: Sequence[str], environment: Mapping[str, str]
) -> tuple[Recipients, set[str]]:
    """The recipients of a command line, and the variables with secrets: no other process should get these.

    Args: notify, log, values of the options. Raises ConfigError for what is wrong with them.
    """
    references = References(environment)
    targets = read_targets(notify, references)
    choices = _once([_sink(text, environment) for text in log])
    stalled = 60 * positive(STALLED, environment, _STALLED_MIN, "minutes, such as 30")
    return Recipients(targets, choices, stalled), references.used


def words_elsewhere(notify: Sequence[str], log: Sequence[str]) -> list[str]:
    """The options of a command on another machine, whose files and variables references name.

    Checked as far as that is possible here. Raises ConfigError for what is no target or sink, or has a
    secret: what a command line has, every user of that machine can read.
    """
    for text in notify:
        check_elsewhere(text)
    for choice in _once([_choice(text) for text in log]):
        if choice.kind == "tensorboard" and choice.place and not Path(choice.place).is_absolute():
            raise ConfigError(f"--log tensorboard:{choice.place}: is on another machine; write it from / on")
    return [
        word
        for name, texts in (("--notify", notify), ("--log", log))
        for text in texts
        for word in (name, text)
    ]


_LINE = TypeAdapter(tuple[Path, int, Recipients])


def to_json(recipients: Recipients, root: Path) -> str:
    """Recipients for the follower of the run at `root`, in one line."""
    return _LINE.dump_json((root.absolute(), os.getpid(), recipients)).decode()


def from_json(text: str) -> tuple[Path, int, Recipients]:
    """The run folder, the process that it belongs to, and the recipients."""
    return _LINE.validate_json(text)


def _once(choices: Sequence[SinkChoice]) -> tuple[SinkChoice, ...]:
    """The sinks. Raises ConfigError if one is given twice."""
    kinds = [choice.kind for choice in choices]
    if len(set(kinds)) < len(kinds):
        raise ConfigError("--log: a sink is given twice; give each once")
    return tuple(choices)


def _choice(text: str) -> SinkChoice:
    """What a text names. Raises ConfigError for no sink, or a password in its URI."""
    kind, _, place = text.partition(":")
    if kind not in _PACKAGES:
        raise ConfigError(f"--log {kind}: there is no such sink; choose one of {', '.join(_PACKAGES)}")
    if kind == "mlflow":
        _require_no_user(place)
    return SinkChoice(kind, place)


def _require_no_user(uri: str) -> None:
    try:
        user = urlsplit(uri).username
    except ValueError as error:
        raise ConfigError("--log mlflow: its URI is none; write http://HOST:PORT") from error
    if user is not None:
        raise ConfigError(
            "--log mlflow: user and password belong into MLFLOW_TRACKING_USERNAME and _PASSWORD"
        )


def _sink(text: str, environment: Mapping[str, str]) -> SinkChoice:
    choice = _choice(text)
    if find_spec(choice.kind) is None:
        package = _PACKAGES[choice.kind]
        raise ConfigError(
            f"--log {choice.kind}: the package {package} is missing; install it: pip install {package}"
        )
    place = choice.place
    if choice.kind == "mlflow" and not place:
        place = environment.get("MLFLOW_TRACKING_URI", "")
        _require_no_user(place)
        if not place:
            raise ConfigError(
                "--log mlflow: no server is named; give --log mlflow:URI or set MLFLOW_TRACKING_URI"
            )
    local = choice.kind == "tensorboard" and place
    return SinkChoice(choice.kind, str(Path(place).absolute()) if local else place)
