"""A stand-in for nvidia-smi."""

from pathlib import Path

import pytest


def print_gpus(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> Path:
    """The only program is an nvidia-smi that prints this; returns the file that it prints.

    It fails where the file is gone. No GPU is selected by CUDA_VISIBLE_DEVICES.
    """
    program, output = folder / "nvidia-smi", folder / "output"
    program.write_text(f'#!/bin/sh\nwhile read -r line; do echo "$line"; done < {output} || exit 9\n')
    program.chmod(0o755)
    output.write_text(text)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    return output
