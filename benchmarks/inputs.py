"""Inputs that users have had: what each came to at another commit, and what it comes to now.

    python -m benchmarks.inputs CASES [--only TEXT] [--panolog COMMAND] [--save FILE]
        [--before FILE] [-o PAGE]

CASES is the folder shared/cases. Each maker of inputs.yaml writes its cases into a scratch folder, and public
commands read them. A row is right (done, with the expected words or value), clear (refused with exit code 2
and a line that says what to do) or wrong. `--panolog` runs the commands of another version, `--save` keeps
its rows with those that FILE has, and `--before` shows kept ones as the first columns of a page of Markdown.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from benchmarks import report
from panolog.scene.files import write_bytes
from panolog.synthetic import make_town

TABLE = Path(__file__).with_suffix(".yaml")
_SHOWN = 150  # characters of what a command says
_MINUTES = 15  # that one command may take
_SECTION = re.compile(r"^== (.+)$", re.MULTILINE)  # of what a script prints


@dataclass(frozen=True)
class Row:
    """One case of one maker."""

    maker: str
    case: str
    way: str  # the command that reads it
    code: int | None  # exit code of the last command; None of a section of a script, which hides it
    said: str  # one line of what the commands said
    verdict: str  # right, clear or wrong

    @property
    def key(self) -> str:
        """What a row of another version is found by."""
        return f"{self.maker} {self.case} {self.way}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark. Returns the exit code: 1 if a row is wrong."""
    parser = report.parser("inputs", __doc__, quick=False)
    parser.add_argument("cases", type=Path, help="the folder shared/cases")
    parser.add_argument("--only", default="", help="makers and cases whose names contain this")
    parser.add_argument("--panolog", default=f"{Path(sys.executable).parent}/panolog", help="the command")
    parser.add_argument("--save", type=Path, help="a JSON file for the rows")
    parser.add_argument("--before", type=Path, help="rows that another version has saved")
    parser.add_argument("-o", "--output", type=Path, help="a page, whose table is replaced")
    options = parser.parse_args(arguments)
    return report.run("inputs", options, lambda: measure(options))


def measure(options: argparse.Namespace) -> report.Report:
    """All rows. Raises InputError if the folder of cases lacks a maker."""
    with TemporaryDirectory(prefix="panolog-inputs-") as folder:
        scratch = Path(folder) / "scratch"  # makers read ../shared/data
        (scratch / ".venv" / "bin").mkdir(parents=True)
        (Path(folder) / "shared").symlink_to(options.cases.resolve().parent)
        (scratch / ".venv" / "bin" / "python").symlink_to(sys.executable)
        (scratch / ".venv" / "bin" / "panolog").symlink_to(options.panolog)
        make_town(scratch / "town", panoramas=16, width=256, points=3000)
        _make(options.cases / "captures" / "mkmodel.py", "", scratch)
        found = _saved(options.save)
        for row in _rows(options, scratch):
            print(f"{row.verdict:5}  {row.key}: {row.said}", file=sys.stderr, flush=True)
            found[row.key] = row
            if options.save:
                write_bytes(options.save, json.dumps([*map(asdict, found.values())], indent=1).encode())
    rows = list(found.values())
    table = _table(rows, _saved(options.before))
    if options.output:
        head = options.output.read_text().partition("\n| maker |")[0]
        write_bytes(options.output, f"{head}\n{table}\n".encode())
    return report.Report(
        {"rows": [asdict(row) for row in rows]}, table, all(row.verdict != "wrong" for row in rows)
    )


def _saved(path: Path | None) -> dict[str, Row]:
    """The rows in a file, by their keys; none without the file."""
    if path is None or not path.is_file():
        return {}
    return {row.key: row for row in (Row(**it) for it in json.loads(path.read_text()))}


def _rows(options: argparse.Namespace, scratch: Path) -> Iterator[Row]:
    for group in yaml.safe_load(TABLE.read_text()):
        maker = options.cases / group["maker"]
        every = dict.fromkeys(group.get("cases", "").split(), "right") | group.get("others", {})
        wanted = {case: it for case, it in every.items() if options.only in f"{group['maker']} {case}"}
        if wanted and group.get("sections"):
            _, text = _make(maker, "", scratch)
            parts = _SECTION.split(text)[1:]
            found = dict(zip(parts[::2], parts[1::2], strict=True))
            yield from (
                _judged(group, case, expected, None, found.get(str(case), ""))
                for case, expected in wanted.items()
            )
            continue
        for number, (case, expected) in enumerate(wanted.items()):
            place = re.sub(r"\W", "_", f"{maker.stem}_{case}_{len(group['commands'])}_{number}")
            names = {"case": case, "out": place, "made": f"{place}_made"}
            code, text = _make(maker, group.get("make", "").format(**names), scratch)
            said = [] if code == 0 else [text]
            for command in () if code else group["commands"].split(" && "):
                code, text = _run([options.panolog, *command.format(**names).split()], scratch)
                said.append(text)
                if code:
                    break
            yield _judged(group, case, expected, code, "\n".join(said))


def _make(maker: Path, arguments: str, scratch: Path) -> tuple[int, str]:
    program = "bash" if maker.suffix == ".sh" else sys.executable
    return _run([program, str(maker), *arguments.split()], scratch)


def _run(command: Sequence[str], folder: Path) -> tuple[int, str]:
    """The exit code of a command, and what it says: errors last if it fails, else first."""
    ended = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, timeout=60 * _MINUTES
    )
    last = (ended.stdout, ended.stderr) if ended.returncode else (ended.stderr, ended.stdout)
    return ended.returncode, "\n".join(last).replace(f"{folder}/", "")


def _judged(group: dict[str, Any], case: object, expected: str, code: int | None, text: str) -> Row:
    """A row, by what `expected` says of its exit code and of what was said."""
    done = expected == "right" or expected.startswith("+")
    pattern = group["right"] if expected == "right" else expected.removeprefix("+")
    found = re.search(pattern, text) if code in (None, 0 if done else 2) else None
    at = text.rfind("PSNR") if "PSNR" in pattern else found.start() if found else -1
    said = text[text.rfind("\n", 0, at) + 1 :] if at >= 0 else text.strip().rpartition("\n")[2]
    said = (said.splitlines() or [""])[0]
    verdict = ("right" if done else "clear") if found else "wrong"
    last = group.get("commands", "the script itself").split(" && ")[-1].partition(" {")[0]
    return Row(group["maker"], str(case), last, code, said.strip()[:_SHOWN], verdict)


def _table(rows: Sequence[Row], before: dict[str, Row]) -> str:
    head = ["maker", "case", "read by", "before", "said before", "now", "says now"]
    cells = []
    for row in rows:
        then = before.get(row.key)
        past = ["–", ""] if then is None else [then.verdict, _cell(then)]
        cells.append([row.maker, row.case, row.way, *past, row.verdict, _cell(row)])
    return report.markdown(head, cells)


def _cell(row: Row) -> str:
    return row.said.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    sys.exit(main())
