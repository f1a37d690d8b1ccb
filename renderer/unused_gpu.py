"""Why torch uses no GPU of this machine, where nvidia-smi lists one. Does not need the compiled core."""

import os

import torch

from panolog.renderer.nvidia_smi import nvidia_smi

# The oldest driver by major version of CUDA: "CUDA Compatibility" of NVIDIA, minor version compatibility.
_DRIVERS = {11: 450, 12: 525, 13: 580}
_HIDDEN = ("", "-1")  # CUDA_VISIBLE_DEVICES of a user, or of Ray, who wants no GPU


def unused_gpu() -> str | None:
    """Why torch uses no GPU, and how to fix that, in one line; None where there is none, or none is wanted.

    Called where `torch.cuda.is_available()` is False.
    """
    if os.environ.get("CUDA_VISIBLE_DEVICES") in _HIDDEN:
        return None
    listed = [row for row in nvidia_smi("name,driver_version") if len(row) == 2]
    if not listed:
        return None
    name, version = listed[0]
    why = _reason(version)
    return f"{name} is not used: {why}"


def _reason(version: str) -> str:
    """Args: version, of the driver, such as 535.104.05."""
    cuda = torch.version.cuda
    if cuda is None:
        return (
            f"torch {torch.__version__} is built without CUDA: install another build, see https://pytorch.org"
        )
    needed = _DRIVERS.get(int(cuda.partition(".")[0]), 0)
    major = version.partition(".")[0]
    if major.isdecimal() and int(major) < needed:
        return (
            f"the NVIDIA driver {version} is too old for torch {torch.__version__} with CUDA {cuda}:"
            f" update it to {needed} or later, or install a torch with an earlier CUDA"
        )
    try:
        torch.cuda.init()  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        first, *_ = str(error).splitlines() or [type(error).__name__]
        return f"{first} (driver {version}, CUDA {cuda})"
    return f"torch {torch.__version__} finds none (driver {version}, CUDA {cuda})"
