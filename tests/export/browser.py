"""A real browser with WebGL on the processor, and a server of a folder, for viewers of others."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

from playwright.sync_api import Page

from tests.orchestrator.watch.dashboard.browser import chromium

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Says nothing."""


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The address at which a folder is served, with what it links to."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def software_page(url: str, first: str = "") -> Iterator[Page]:
    """A page of 800×600 pixels in Debian's Chromium; at the end, nothing may have gone wrong in it.

    Args: first, a script that runs before those of the page.
    """
    wrong = list[str]()
    with chromium(SOFTWARE) as browser:
        page = browser.new_page(viewport={"width": 800, "height": 600})
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.add_init_script(first)
        page.set_default_timeout(300_000)
        try:
            page.goto(url)
            yield page
        finally:
            assert wrong == []  # which also explains what else has failed
