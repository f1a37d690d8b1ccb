"""What tests of workers share."""

import pytest

from panolog.scene.model import Scene
from tests.workers.small import small_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene, to read only."""
    return small_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(autouse=True)
def _no_lpips(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations are the same whether it is installed or not."""
    monkeypatch.setattr("panolog.workers.evaluation.load_lpips", lambda _: (None, None))
