"""The log: off by default, on stderr only, with the level that the option or the variable names."""

import logging
import os
import re
import subprocess
import sys

import pytest

from panolog.orchestrator.runs import log
from panolog.scene.errors import ConfigError

LINE = r"\d{4}-\d\d-\d\d [\d:,]+ (\w+) \d+ panolog\.test: (.*)\n"
SCRIPT = """
import logging
from panolog.orchestrator.runs import log
log.configure({verbose})
log.configure()
logger = logging.getLogger("panolog.test")
logger.debug("detail"), logger.info("decision of %s", "a driver")
print("result")
"""
PROGRAM = """
import logging
from panolog.orchestrator.cli.app import app
try:
    app(["-vv", "status"])
finally:
    print(logging.getLogger("panolog").getEffectiveLevel())
"""


@pytest.mark.parametrize(
    ("verbose", "level", "expected"),
    [
        (0, None, []),
        (0, "info", [("INFO", "decision of a driver")]),
        (1, None, [("INFO", "decision of a driver")]),
        (2, "ERROR", [("DEBUG", "detail"), ("INFO", "decision of a driver")]),
        (0, "ERROR", []),
    ],
)
def test_levels(verbose: int, level: str | None, expected: list[tuple[str, str]]) -> None:
    environment = {name: value for name, value in os.environ.items() if name != log.VARIABLE}
    environment |= {log.VARIABLE: level} if level else {}
    command = [sys.executable, "-c", SCRIPT.format(verbose=verbose)]
    ended = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    assert ended.stdout == "result\n"
    assert re.findall(LINE, ended.stderr) == expected
    assert re.sub(LINE, "", ended.stderr) == ""


def test_an_unknown_level_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(log.VARIABLE, "loud")
    with pytest.raises(ConfigError, match="PANOLOG_LOG=loud: choose one of DEBUG"):
        log.configure()


def test_the_option_of_the_program() -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM], check=False, capture_output=True, text=True)
    assert ended.stdout.splitlines()[-1] == str(logging.DEBUG)
