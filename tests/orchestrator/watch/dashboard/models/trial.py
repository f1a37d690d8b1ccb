"""What the process of `making` is requested to do in its tests."""

import os
import time
from pathlib import Path

from panolog.scene.errors import InputError


def main(kind: str, output: str) -> None:
    """Notes the process in a file, unless it hangs, and then does as the kind says."""
    if kind == "hang":  # at once: what is noted would depend on how far it came in its time
        time.sleep(1e6)
    with Path(output).open("a") as file:
        file.write(f"{os.getpid()}\n")
    match kind:
        case "print":
            print("[null, 1e9]")  # is no answer
        case "refuse":
            raise InputError("a.ply: is no model")
        case "fail":
            raise ValueError("one\nline")
        case "die":
            os._exit(3)
