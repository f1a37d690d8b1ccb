"""The shell in deploy/: shellcheck reads it, and the Slurm script runs with programs that record calls."""

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.deploy.files import DEPLOY, ROOT, commands, load, load_all, programs
from tests.ray_head import BIN, wait_until

pytestmark = pytest.mark.system

LIMIT_S = 300
# Programs that record how they were called, with the token's length in place of the token.
RECORDS = '#!/bin/bash\necho "${0##*/} $* token ${#RAY_AUTH_TOKEN} $RAY_AUTH_MODE" >> "$CALLS"\n'
RUNS = RECORDS + "exec sleep 600\n"
# What the script starts in the background may record its call after the driver's.
AFTER_OTHERS = "".join(
    f'until grep --quiet "^{call}" "$CALLS"; do sleep 0.05; done\n' for call in ("srun", "ray start")
)
DRIVER = RECORDS.replace("\n", "\ntrap 'exit 130' TERM\n", 1) + "sleep 600 & wait\n"


def shellcheck(*arguments: str, text: str | None = None) -> None:
    ended = subprocess.run(
        [BIN / "shellcheck", *arguments], check=False, cwd=ROOT, input=text, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_shellcheck_accepts_scripts_and_commands() -> None:
    shellcheck("--external-sources", "deploy/slurm.sh", "deploy/slurm-array.sh", "deploy/nodes.sh")
    shellcheck("--shell=bash", "--exclude=SC2034", "deploy/recovery.env")  # settings for others to read
    both = [command for name in ("on-premises.yaml", "aws.yaml") for command in commands(load(name))]
    for command in dict.fromkeys(both):
        shellcheck("--shell=bash", "--exclude=SC1090,SC1091", "-", text=f"{command}\n")
    shellcheck("--shell=sh", "-", text=load_all("kuberay.yaml")[0]["spec"]["entrypoint"] + "\n")


class Slurm:
    """The environment of the script when Slurm starts it on the first of three nodes."""

    def __init__(self, folder: Path, driver: str) -> None:
        self.calls = folder / "calls"
        self.run = folder / "run"
        ray = RECORDS + "[[ $1 == health-check ]] || exec sleep 600\n"
        scripts = {"srun": RUNS, "scontrol": RECORDS, "panolog": driver, "ray": ray}
        programs(folder / ".venv" / "bin", scripts)
        (folder / ".venv/bin/activate").write_text(f"PATH={folder}/.venv/bin:$PATH\n")
        (folder / "deploy").symlink_to(DEPLOY)
        slurm = {"SLURM_SUBMIT_DIR": folder, "SLURMD_NODENAME": "n0", "SLURM_NNODES": 3, "SLURM_JOB_ID": 7}
        self._environment = os.environ | {"CALLS": str(self.calls)}
        self._environment |= {name: str(value) for name, value in slurm.items()}

    @contextmanager
    def started(self, list_: str = "", line: int = 0) -> Iterator[subprocess.Popen[str]]:
        """The script while the context lasts. Args: list_, of runs, of which it does a line."""
        command = [str(DEPLOY / "slurm.sh"), "/data/street", str(self.run), "--blocks", "2x2x1"]
        if list_:
            runs = self.calls.with_name("runs.txt")
            runs.write_text(list_)
            command = [str(DEPLOY / "slurm-array.sh"), str(runs)]
        ours = self._environment | {"SLURM_ARRAY_TASK_ID": str(line)}
        with subprocess.Popen(
            command, env=ours, start_new_session=True, stderr=subprocess.PIPE, text=True
        ) as process:
            try:
                yield process
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)

    def calls_of(self, program: str) -> list[str]:
        lines = self.calls.read_text().splitlines() if self.calls.exists() else []
        return [line for line in lines if line.startswith(f"{program} ")]


@pytest.mark.parametrize("code", [0, 2])
def test_slurm_starts_ray_on_all_nodes_and_ends_as_the_driver_does(tmp_path: Path, code: int) -> None:
    slurm = Slurm(tmp_path, f"{RECORDS}{AFTER_OTHERS}exit {code}\n")
    with slurm.started() as process:
        assert process.wait(LIMIT_S) == code
    (head,) = (call for call in slurm.calls_of("ray") if call.startswith("ray start"))
    assert "--head --block" in head
    assert head.endswith("token 64 token")
    (workers,) = slurm.calls_of("srun")
    assert "--nodes=2" in workers
    assert "--exclude=n0" in workers
    assert "ray start --address=" in workers
    (driver,) = slurm.calls_of("panolog")
    assert driver.startswith(f"panolog run /data/street --output {slurm.run} --address=")
    assert "--blocks 2x2x1 token 64 token" in driver
    assert not slurm.calls_of("scontrol")


def test_slurm_queues_a_run_again_that_its_signal_has_interrupted(tmp_path: Path) -> None:
    slurm = Slurm(tmp_path, DRIVER)
    slurm.run.mkdir()
    (slurm.run / "run.json").touch()
    assert interrupted(slurm).startswith(f"panolog resume {slurm.run} --address=")


def test_a_task_of_an_array_runs_its_line_of_the_list(tmp_path: Path) -> None:
    slurm = Slurm(tmp_path, DRIVER)
    content = f"/data/street /data/runs/street\n/data/harbour '{slurm.run} 2' --blocks '2x2x1'\n"
    driver = interrupted(slurm, content, 2)
    assert driver.startswith(f"panolog run /data/harbour --output {slurm.run} 2 --address=")
    assert "--supervise --blocks 2x2x1 token" in driver


def interrupted(slurm: Slurm, list_: str = "", line: int = 0) -> str:
    """The call of a driver that gets Slurm's signal, which is for the process that Slurm has started."""
    with slurm.started(list_, line) as process:
        wait_until(lambda: slurm.calls_of("panolog"), "the driver has begun")
        process.terminate()
        assert process.wait(LIMIT_S) == 130
    assert slurm.calls_of("scontrol")[0].startswith("scontrol requeue 7 ")
    (driver,) = slurm.calls_of("panolog")
    return driver


@pytest.mark.parametrize("line", [2, 3])
def test_a_line_that_is_missing_or_short_is_wrong_input(tmp_path: Path, line: int) -> None:
    slurm = Slurm(tmp_path, DRIVER)
    with slurm.started("/data/street /data/runs/street\n/data/harbour\n", line) as process:
        _, said = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 2
    assert f"runs.txt: line {line} is not of the form SCENE RUN [options]" in said


def test_an_array_requests_what_a_single_run_does() -> None:
    def requests(name: str) -> list[str]:
        lines = (DEPLOY / name).read_text().splitlines()
        return [line for line in lines if line.startswith("#SBATCH") and "--output" not in line]

    assert requests("slurm-array.sh") == requests("slurm.sh")
