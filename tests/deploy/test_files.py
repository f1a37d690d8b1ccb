"""The image, the Grafana dashboard, which uses the metrics that the driver exports, and the pages."""

import json
import re
import shlex
import subprocess
from collections.abc import Iterator
from fnmatch import fnmatch

from panolog.orchestrator.engine.cluster.run_metrics import COUNTERS, GAUGES, TAGS
from tests.deploy.files import DEPLOY, ROOT, parsed
from tests.ray_head import BIN


def test_hadolint_accepts_it() -> None:
    ended = subprocess.run(
        [BIN / "hadolint", DEPLOY / "Dockerfile"], check=False, capture_output=True, text=True
    )
    assert (ended.returncode, ended.stdout) == (0, ""), ended.stdout


def test_the_build_context_has_the_sources_of_the_wheel() -> None:
    lines = (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines()
    kept = {line[1:] for line in lines if line.startswith("!")}
    assert all((ROOT / name).exists() for name in kept)
    packages = {link.name for link in (ROOT / "src/panolog").iterdir() if link.is_symlink()}
    assert packages | {"src", "pyproject.toml", "CMakeLists.txt", "README.md", "LICENSE"} <= kept
    copied = [
        word
        for line in (DEPLOY / "Dockerfile").read_text().splitlines()
        if line.startswith("COPY ") and "--from" not in line
        for word in line.split()[1:-1]
        if word != "."
    ]
    assert copied
    for name in copied:
        assert any(fnmatch(name, pattern) or name.startswith(f"{pattern}/") for pattern in kept), name


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


PAGES = sorted(DEPLOY.glob("*.md"))


def test_every_file_has_a_page() -> None:
    text = "".join(page.read_text() for page in PAGES)
    for file in DEPLOY.iterdir():
        assert file.suffix in (".md", ".dockerignore") or f"{file.name}" in text, file.name


def shown() -> list[list[str]]:
    """The panolog commands in the pages' examples, without optional arguments."""
    examples = [
        line.strip().removeprefix(".venv/bin/")
        for page in PAGES
        for line in page.read_text().splitlines()
        if line.startswith("    ")
    ]
    lines = [
        line.split("#")[0].split("[")[0].rstrip(" \\") for line in examples if line.startswith("panolog ")
    ]
    return [shlex.split(line)[1:] for line in lines]


def test_commands_are_as_the_pages_show_them() -> None:
    assert len(shown()) > 8
    for words in shown():
        parsed(words)
