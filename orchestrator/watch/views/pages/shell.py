"""The page around what is shown: live, as the dashboard serves it, or as one file with a snapshot in it.

Both have the same scripts, which ask for data by its paths below /api; in a file they find the answers in
the snapshot. Scripts import each other as `panolog/FOLDER/NAME.js`, and an import map says where that is:
below /static/, or in the page itself. Nothing of a run becomes markup: names, notices and errors are
untrusted text, which scripts show as text.
"""

import base64
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.scene.files import write_bytes

STATIC = Path(__file__).parents[2] / "dashboard" / "static"
PLOTLY = STATIC.with_name("vendor") / "plotly.min.js"  # npm's plotly.js-cartesian-dist-min, 4.1.1
LIVE_IMPORTS = '{"imports": {"panolog/": "/static/"}}'
_KINDS = {".js": "text/javascript", ".svg": "image/svg+xml"}  # media types of what a file has as URLs
_SHARED = "shared"  # the folder of what all pages have


@dataclass(frozen=True)
class Page:
    """A page: its content and its script are in a folder of static/."""

    folder: str
    title: str  # until its script knows better
    script: str
    styles: tuple[str, ...]
    charts: bool = False  # whether plotly is needed at once

    @property
    def scripts(self) -> list[str]:
        """What its script imports, by path in static/."""
        found = sorted(STATIC.glob(f"{_SHARED}/*.js")) + sorted(STATIC.glob(f"{self.folder}/*.js"))
        return [path.relative_to(STATIC).as_posix() for path in found]


RUNS = Page("runs", "Runs", "runs/runs.js", ("shared/base.css", "runs/runs.css"))
RUN = Page("run", "Run", "run/run.js", ("shared/base.css", "shared/compare.css", "run/run.css"))
COMPARISON = Page(
    "compare",
    "Comparison",
    "compare/page.js",
    ("shared/base.css", "shared/compare.css", "compare/comparison.css"),
    charts=True,
)


def live_page(page: Page) -> str:
    """A page that requests what it shows from the dashboard."""
    return _render(page, url=lambda path: f"/static/{path}", imports=Markup(LIVE_IMPORTS), snapshot=None)


def write_snapshot(
    path: Path,
    page: Page,
    answers: Mapping[str, Any],
    stream: Mapping[str, Any],
    own_paths: Sequence[str] = (),
) -> None:
    """Writes a page as one file that needs no server, atomically.

    Args: answers, JSON or URLs of pictures by their paths below /api; stream, the messages of the stream;
    own_paths, those of this machine, the longest first, of which only the last part is shown.
    Raises OSError if it cannot be written.
    """
    snapshot = encode({"answers": answers, "stream": stream}).decode()
    for own in own_paths:
        snapshot = snapshot.replace(encode(own).decode()[1:-1], encode(Path(own).name).decode()[1:-1])
    imports = {f"panolog/{name}": _data_url_of(name) for name in page.scripts}
    text = _render(
        page,
        url=_data_url_of,
        text=_text_of,
        imports=Markup(json.dumps({"imports": imports})),
        snapshot=Markup(snapshot.replace("<", r"\u003c")),  # no text ends the element that it is in
        plotly=Markup(PLOTLY.read_text(encoding="utf-8")),
        # Readers may be in another time zone.
        made=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(time.time())),
    )
    write_bytes(path, text.encode())


def data_url(kind: str, content: bytes) -> str:
    """A file as a URL. Args: kind, its media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _render(page: Page, **values: Any) -> str:
    content = _text_of(f"{page.folder}/content.html")
    return _template().render(page=page, content=content, **values)


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(Path(__file__).with_name("page.html.j2").read_text(encoding="utf-8"))


def _text_of(path: str) -> Markup:
    """A file of static/, as it is."""
    return Markup((STATIC / path).read_text(encoding="utf-8"))


def _data_url_of(path: str) -> str:
    """A file of static/ as a URL."""
    return data_url(_KINDS[Path(path).suffix], (STATIC / path).read_bytes())
