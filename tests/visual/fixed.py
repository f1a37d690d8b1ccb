"""What differs between machines and moments, held fixed, so that pages look the same everywhere.

The time, the host name, and the fonts: those that matplotlib brings, whatever the machine has.
"""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import matplotlib as mpl

from panolog.orchestrator.runs.preparation import forecast

NOW = datetime(2026, 3, 14, 15, 9, 26, tzinfo=timezone.utc)
HOST = "atlas"
_FONTCONFIG = """<?xml version="1.0"?>
<!DOCTYPE fontconfig SYSTEM "fonts.dtd">
<fontconfig>
  <dir>{fonts}</dir>
  <cachedir>{cache}</cachedir>
  <selectfont><rejectfont><glob>*/cm*</glob></rejectfont><rejectfont><glob>*/STIX*</glob></rejectfont></selectfont>
  <alias binding="same"><family>serif</family><prefer><family>DejaVu Serif</family></prefer></alias>
  <alias binding="same"><family>monospace</family><prefer><family>DejaVu Sans Mono</family></prefer></alias>
  <alias binding="same"><family>system-ui</family><prefer><family>DejaVu Sans</family></prefer></alias>
  <alias binding="same"><family>sans-serif</family><prefer><family>DejaVu Sans</family></prefer></alias>
  <match target="font">
    <edit name="antialias" mode="assign"><bool>true</bool></edit>
    <edit name="hinting" mode="assign"><bool>false</bool></edit>
    <edit name="rgba" mode="assign"><const>none</const></edit>
  </match>
</fontconfig>
"""


@dataclass
class Clock:
    """A clock that is set by hand, in seconds since the epoch."""

    now: float = NOW.timestamp()


@contextmanager
def fixed_machine() -> Iterator[Clock]:
    """This process has one host name, eight cores, no GPU and the clock's time while the context lasts."""
    clock = Clock()
    with (
        patch.object(time, "time", lambda: clock.now),
        patch.object(socket, "gethostname", lambda: HOST),
        patch.object(forecast, "cores", lambda: 8),
        patch.object(forecast, "DRIVER", Path("none")),
    ):
        yield clock


@contextmanager
def fixed_fonts() -> Iterator[dict[str, str | float | bool]]:
    """The environment of a browser that has the fonts of matplotlib alone."""
    fonts = Path(mpl.get_data_path(), "fonts", "ttf")
    with TemporaryDirectory(prefix="fonts-") as folder:
        config = Path(folder, "fonts.conf")
        config.write_text(_FONTCONFIG.format(fonts=fonts, cache=folder))
        yield {**os.environ, "FONTCONFIG_FILE": str(config), "TZ": "UTC", "LANGUAGE": "en_US"}
