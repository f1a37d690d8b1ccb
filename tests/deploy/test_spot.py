"""Tasks of SkyPilot and dstack: what they start, and that the tools themselves read them, where installed."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.deploy.files import DEPLOY, ROOT, load, programs

RECORDS = '#!/bin/bash\necho "${0##*/} $*" >> "$CALLS"\n'
SCENE, RUN = "s3://bucket/scene", "s3://bucket/run"


def started(tmp_path: Path, rank: int, *, exists: bool = False, heads: int = 1) -> list[str]:
    """What `nodes.sh` calls. Args: exists, whether the run does; heads, times the first machine answers."""
    calls = tmp_path / "calls"
    scripts = {
        "panolog": RECORDS + ("" if exists else "[[ $1 != status ]] || exit 2\n"),
        "ray": RECORDS
        + '[[ $1 != health-check ]] || (($(grep --count health-check "$CALLS") <= HEADS)) || exit 1\n',
        "sleep": "#!/bin/bash\n",
    }
    programs(tmp_path, scripts)
    environment = os.environ | {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "CALLS": str(calls),
        "HEADS": str(heads),
        "RANK": str(rank),
        "HEAD": "10.0.0.4",
    }
    subprocess.run([DEPLOY / "nodes.sh", SCENE, RUN, "--seed", "3"], env=environment, check=True)
    return calls.read_text().splitlines()


@pytest.mark.parametrize("exists", [False, True])
def test_the_first_machine_starts_or_resumes_the_run(tmp_path: Path, exists: bool) -> None:
    address = "--address=10.0.0.4:6380"
    run = f"resume {RUN} {address}" if exists else f"run {SCENE} --output {RUN} {address} --seed 3"
    assert started(tmp_path, 0, exists=exists) == [
        "ray start --head --node-ip-address=10.0.0.4 --port=6380",
        f"panolog status {RUN}",
        f"panolog {run}",
        "ray stop",
    ]


def test_another_machine_joins_again_until_the_first_has_ended(tmp_path: Path) -> None:
    joined = [call for call in started(tmp_path, 2, heads=3) if "health-check" not in call]
    assert joined == ["ray start --address=10.0.0.4:6380 --block"] * 2


@pytest.mark.parametrize(
    ("file", "rank", "commands"),
    [
        ("skypilot.yaml", "$SKYPILOT_NODE_RANK", lambda task: [task["setup"], task["run"]]),
        ("panolog.dstack.yml", "$DSTACK_NODE_RANK", lambda task: task["commands"]),
    ],
)
def test_the_tasks_start_it_with_their_rank(file: str, rank: str, commands: object) -> None:
    assert callable(commands)
    text = "\n".join(commands(load(file)))
    assert f"RANK={rank} HEAD=" in text
    assert 'deploy/nodes.sh "$SCENE" "$RUN" $OPTIONS' in text
    assert "make setup" in text


SKYPILOT = """
import sys, sky
task = sky.Task.from_yaml(sys.argv[1])
print(task.num_nodes, all(resources.use_spot for resources in task.resources))
"""
DSTACK = """
import sys, yaml
from dstack._internal.core.models.configurations import parse_apply_configuration
print(parse_apply_configuration(yaml.safe_load(open(sys.argv[1]))).nodes)
"""


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("program", "file", "found"),
    [(SKYPILOT, "skypilot.yaml", "4 True"), (DSTACK, "panolog.dstack.yml", "4")],
    ids=["skypilot", "dstack"],
)
def test_the_launcher_itself_reads_its_task(program: str, file: str, found: str, tmp_path: Path) -> None:
    """SkyPilot and dstack have an environment of their own: they pin other versions than PanoLOG does."""
    python = ROOT / "build" / "peers" / "bin" / "python"
    if not python.exists():
        pytest.skip("skypilot and dstack are not installed: make nightly")
    command, home = [str(python), "-c", program, str(DEPLOY / file)], os.environ | {"HOME": str(tmp_path)}
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300, env=home)
    assert ended.stdout.split() == found.split(), ended.stderr
