"""Names of tasks for people."""

import re
from pathlib import Path

import pytest

from panolog.orchestrator.watch.views.summary import task_label
from panolog.workers.tasks import Stage

FORMAT = Path(__file__).parents[4] / "orchestrator/watch/dashboard/static/shared/format.js"


@pytest.mark.parametrize(
    ("task", "label"),
    [
        ("coarse", "Stage I"),
        ("score/012", "scoring 12"),
        ("plan", "partition"),
        ("block/003", "block 3"),
        ("merge", "merge"),
        ("eval", "evaluation"),
        ("report", "report"),
        ("", "run"),
    ],
)
def test_a_task_has_one_name(task: str, label: str) -> None:
    assert task_label(task) == label


def test_the_dashboard_has_the_same_names() -> None:
    match = re.search(r"const TASKS = \{(.*?)\};", FORMAT.read_text(), re.DOTALL)
    assert match is not None
    names = dict(re.findall(r'(\w+): "([^"]+)"', match[1]))
    assert names == {stage.value: task_label(stage.value) for stage in Stage}
