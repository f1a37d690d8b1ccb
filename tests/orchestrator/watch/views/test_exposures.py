"""The curve of exposures: thinned, and nothing is believed of a file that is none."""

import json
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views.exposures import exposure_curve


def written(root: Path, content: Any) -> RunFolder:
    (root / "exposure.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return RunFolder(root)


def panorama(number: int, **changes: Any) -> dict[str, Any]:
    return {
        "name": f"{number}.jpg",
        "stops": number / 100,
        "gain": [1, 2, 0.5],
        "black": [0, 0, 0],
        **changes,
    }


def test_a_curve_has_both_ends_and_stops_of_each_channel(tmp_path: Path) -> None:
    folder = written(tmp_path, {"panoramas": [panorama(number) for number in range(1_500)]})
    curve = exposure_curve(folder, Path.read_bytes)
    assert curve is not None
    assert len(curve.name) == len(curve.stops) == len(curve.red) == 600
    assert (curve.name[0], curve.name[-1], curve.stops[-1]) == ("0.jpg", "1499.jpg", 14.99)
    assert (curve.red[0], curve.green[0], curve.blue[0]) == (0, 1, -1)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{",
        {"panoramas": []},
        {"panoramas": [panorama(0, gain=[0, 1, 1])]},
        {"panoramas": [panorama(0, gain=[1, 1])]},
        '{"panoramas": [{"name": "a", "stops": NaN, "gain": [1, 1, 1]}]}',
        "[" * 100_000,
    ],
)
def test_another_format_is_no_curve(content: Any, tmp_path: Path) -> None:
    assert exposure_curve(written(tmp_path, content), Path.read_bytes) is None
