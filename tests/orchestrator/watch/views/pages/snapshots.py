"""What a page that was written as one file holds."""

import json
import re
from typing import Any


def snapshot_of(page: str) -> dict[str, Any]:
    """The answers of the API and the messages of the stream that a page with a snapshot holds."""
    match = re.search(r'<script type="application/json" id="snapshot">(.*?)</script>', page, re.DOTALL)
    assert match is not None
    found: dict[str, Any] = json.loads(match[1], parse_constant=_no_json)
    return found


def self_contained(page: str) -> bool:
    """Whether a page requests nothing, but for what Plotly's code says."""
    beyond_plotly = page.replace(
        page[page.index("<script>/**") : page.index('<script type="application')], ""
    )
    return not re.search(r"""(src|href)\s*=\s*["']?(https?:|//|\.|/)|url\((?!data:)""", beyond_plotly)


def _no_json(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")
