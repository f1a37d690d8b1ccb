"""What nvidia-smi prints. A separate module: processes without torch use it too."""

import shutil
import subprocess

_TIMEOUT_S = 30.0  # a machine without persistence mode wakes its GPUs first


def nvidia_smi(fields: str) -> list[list[str]]:
    """The rows that nvidia-smi prints of all GPUs, with these fields; none where it is missing or fails."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    command = [program, f"--query-gpu={fields}", "--format=csv,noheader,nounits"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    return [[cell.strip() for cell in line.split(",")] for line in done.stdout.splitlines()]
