"""The Grafana dashboard: its queries use the metrics that the driver exports, all of them."""

import json
import re
from collections.abc import Iterator
from typing import Any

from panolog.orchestrator.engine.cluster.run_metrics import COUNTERS, GAUGES, TAGS
from tests.deploy.files import DEPLOY

DASHBOARD = json.loads((DEPLOY / "grafana.json").read_text())
EXPORTED = {f"ray_{name}" for name in (*GAUGES, *COUNTERS)}


def queries() -> Iterator[str]:
    for panel in DASHBOARD["panels"]:
        for target in panel["targets"]:
            yield target["expr"]
    for variable in DASHBOARD["templating"]["list"]:
        if variable["type"] == "query":
            yield variable["query"]["query"]


def metrics(text: str) -> set[str]:
    return set(re.findall(r"\bray_\w+", text))


def test_the_dashboard_shows_every_exported_metric_and_no_other() -> None:
    assert set.union(*map(metrics, queries())) == EXPORTED
    assert metrics((DEPLOY / "metrics.md").read_text()) == EXPORTED


def test_queries_are_whole_and_use_our_tags() -> None:
    for query in queries():
        assert query.count("(") == query.count(")")
        assert query.count("{") == query.count("}")
        labels = set(re.findall(r"(\w+)=~", query))
        for group in re.findall(r" by \(([^)]*)\)", query):
            labels |= {label.strip() for label in group.split(",")}
        assert labels <= set(TAGS), query
    legends = [target["legendFormat"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
    assert set(re.findall(r"{{(\w+)}}", " ".join(legends))) <= set(TAGS)


def test_grafana_can_lay_it_out() -> None:
    panels: list[dict[str, Any]] = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    assert {panel["type"] for panel in panels} <= {"timeseries", "stat", "bargauge"}
    assert all(panel["gridPos"]["x"] + panel["gridPos"]["w"] <= 24 for panel in panels)
    variables = {variable["name"] for variable in DASHBOARD["templating"]["list"]}
    used = set(re.findall(r"\$\{?(\w+)\}?", json.dumps(DASHBOARD))) - {"__rate_interval", "__range", "__all"}
    assert used <= variables
