"""Writes the page of a model: a folder for any web server, or one file that works from the disk.

The folder has the scripts as they are in `static/`, PlayCanvas's engine as engine.js with its licence,
scene.json, the model and sky.jpg. The one file has all of it inside; its scripts import each other by names
that an import map resolves, because a relative path has no meaning there.

Engine: https://github.com/playcanvas/engine, npm package playcanvas, build/playcanvas.min.mjs, MIT licence.
"""

import base64
import json
from collections.abc import Callable
from functools import cache
from html import escape
from pathlib import Path, PurePosixPath
from typing import Any

from panolog.export.site.page import Page
from panolog.scene.errors import ConfigError
from panolog.scene.files import atomic_folder, write_bytes

MOST_IN_ONE = 1_000_000  # Gaussians of a page that is one file: 15 to 25 MB
ENTRY, ENGINE, DESCRIPTION, SKY = "viewer.js", "engine.js", "scene.json", "sky.jpg"
EXPERIENCE = "settings.json"  # of other viewers
ENGINE_VERSION = "2.23.3"
ENGINE_SHA256 = "3b014294ecd91bcefc11b53e5196ae41aecb1b4475c18d1d91d1b10eee201ff6"
# Of the one file: only what is inside it, and the worker that the engine makes of its own text.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data: blob:;"
    " connect-src data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'"
)
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".jpg": "image/jpeg",
    ".webp": "image/webp",
    ".txt": "text/plain; charset=utf-8",
}
_STATIC, _VENDOR = (Path(__file__).with_name(name) for name in ("static", "vendor"))
_STYLE = '<link rel="stylesheet" href="viewer.css" crossorigin>'
_PRELOAD = f'<link rel="modulepreload" href="{ENGINE}">\n'
_SCRIPT = f'<script type="module" src="{ENTRY}"></script>'


def write_site(folder: Path, write_model: Callable[[Path], str], page: Page) -> None:
    """Writes the page of a model as a folder, which appears whole; one of ours that is there is replaced.

    Args: write_model writes the model into the folder that it is given, and returns its path there with "/":
    that of a .sog, or of the lod-meta.json of Streamed SOG.
    Raises ConfigError if there is something else at `folder`; OSError if it cannot be written.
    """
    free = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    ours = all((folder / name).is_file() for name in (DESCRIPTION, ENTRY, ENGINE))
    if folder.is_symlink() or not (free or ours):
        raise ConfigError(f"{folder}: is not a page of a model, and is not replaced; give a new folder")
    with atomic_folder(folder) as new:
        model = write_model(new)
        _write_parts(new, page, model)


def write_page(path: Path, model: bytes, page: Page) -> None:
    """Writes the page of a model as one file, atomically. Args: model, the bytes of a .sog.

    Raises OSError if it cannot be written.
    """
    sky = None if page.sky is None else f"data:image/jpeg;base64,{_base64(page.sky)}"
    scripts = {name: text.replace('from "./', 'from "panolog/') for name, text in _scripts().items()}
    entry = scripts.pop(ENTRY)
    urls = {
        f"panolog/{name}": f"data:text/javascript;base64,{_base64(text.encode())}"
        for name, text in scripts.items()
    }
    parts = (
        _element("importmap", "", json.dumps({"imports": urls})),
        _element("application/json", "scene", _json(page.as_json("model.sog", sky))),
        _element("application/octet-stream", "model", _base64(model)),
        _element("module", "", entry),
    )
    policy = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    style = f"<style>\n{_text('viewer.css')}</style>\n<!--\n{_licence()}-->"
    html = _document(page, {_PRELOAD: f"{policy}\n", _STYLE: style, _SCRIPT: "\n".join(parts)})
    write_bytes(path, html.encode())


def media_type(path: str) -> str:
    """The Content-Type of a file of a page."""
    return _TYPES.get(PurePosixPath(path).suffix.lower(), "application/octet-stream")


def site_files(folder: Path) -> dict[str, Path]:
    """The files of a written page by their paths with "/", links left out."""
    return {
        path.relative_to(folder).as_posix(): path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


def _write_parts(folder: Path, page: Page, model: str) -> None:
    """All files but the model."""
    for name, text in _scripts().items():
        (folder / name).write_text(text)
    (folder / "engine.LICENSE.txt").write_text(_licence())
    (folder / "viewer.css").write_text(_text("viewer.css"))
    (folder / "index.html").write_text(_document(page, {}))
    if page.sky is not None:
        (folder / SKY).write_bytes(page.sky)
    sky = None if page.sky is None else SKY
    (folder / DESCRIPTION).write_text(_json(page.as_json(model, sky)))
    (folder / EXPERIENCE).write_text(_json(page.as_experience(sky)))


def _document(page: Page, replaced: dict[str, str]) -> str:
    """index.html with the page's title, and other parts in place of its links."""
    html = _text("index.html")
    for place, text in (
        {"<title>PanoLOG</title>": f"<title>{escape(page.title)}</title>"} | replaced
    ).items():
        before, found, after = html.partition(place)
        assert found, f"index.html has no {place}"
        html = before + text + after
    return html


def _json(content: dict[str, Any]) -> str:
    """JSON that can be inside an element of a page. Raises ValueError for numbers that are not finite."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _element(kind: str, name: str, text: str) -> str:
    assert "</script" not in text.lower(), f"a script of the page ends its element: {name or kind}"
    label = f' id="{name}"' if name else ""
    return f'<script type="{kind}"{label}>{text}</script>'


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


@cache
def _scripts() -> dict[str, str]:
    """The page's scripts by name, the engine among them."""
    scripts = {path.name: path.read_text() for path in sorted(_STATIC.glob("*.js"))}
    return scripts | {ENGINE: (_VENDOR / "playcanvas.min.mjs").read_text()}


def _text(name: str) -> str:
    return (_STATIC / name).read_text()


def _licence() -> str:
    return f"engine.js is PlayCanvas {ENGINE_VERSION}.\n\n{(_VENDOR / 'playcanvas.LICENSE.txt').read_text()}"
