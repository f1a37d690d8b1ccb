"""The results of all steps as first-hour.json and first-hour.md, written anew after each step."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.first_hour.steps import STEPS
from benchmarks.report import markdown
from panolog.scene.files import write_bytes

NAME = "first-hour"
Entry = dict[str, Any]  # of a step, as in the JSON


def read(folder: Path) -> Entry | None:
    """The results that a folder has from before.

    Raises ValueError if it has anything else: steps remove what is in the way.
    """
    file = folder / f"{NAME}.json"
    if not file.exists():
        if any(folder.iterdir()):
            raise ValueError("has other files than results of first_hour; take a new folder")
        return None
    content = json.loads(file.read_bytes())
    if not isinstance(content, dict) or not {"device", "steps"} <= content.keys():
        raise ValueError(f"{file.name} has no results of first_hour; take a new folder")
    return content


def write(folder: Path, content: Entry) -> None:
    """Writes both files. Args: content, with the keys command, device, minutes, began and steps."""
    write_bytes(folder / f"{NAME}.json", (json.dumps(content, indent=2) + "\n").encode())
    write_bytes(folder / f"{NAME}.md", "\n\n".join(_parts(folder, content)).encode() + b"\n")


def _parts(folder: Path, content: Entry) -> Iterator[str]:
    steps: Mapping[str, Entry] = {name: content["steps"][name] for name in STEPS if name in content["steps"]}
    yield "# The first hour with a card" if content["device"] == "cuda" else "# A rehearsal on the CPU"
    yield f"{content['began']}, {content['minutes']:g} minutes at most: `{content['command']}`"
    rows = [_row(name, entry) for name, entry in steps.items()]
    yield markdown(("step", "outcome", "seconds", "main figure or reason"), rows)
    yield "The commands below do the same by hand, in the root of the repository."
    for name, entry in steps.items():
        yield f"## {name}: {STEPS[name].what}"
        yield from _section(folder, name, entry)


def _row(name: str, entry: Entry) -> tuple[object, ...]:
    said = [part for part in (entry["figure"], entry["reason"]) if part]
    return name, _ending(entry), round(entry["seconds"]), _cell("; ".join(said))


def _ending(entry: Entry) -> str:
    return "**failed**" if entry["ending"] == "failed" else entry["ending"]


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|")


def _section(folder: Path, name: str, entry: Entry) -> Iterator[str]:
    if entry["reason"]:
        yield f"{_ending(entry)}: {_cell(entry['reason'])}"
    if entry["commands"]:
        yield "\n".join(["```", *entry["commands"], "```"])
    if entry["text"]:
        yield entry["text"]
    log = Path(name, "log.txt")
    if (folder / log).exists() and (folder / log).stat().st_size:
        yield f"Of at most {entry['limit']:.0f} s it took {entry['seconds']:.0f}; it printed `{log}`."
