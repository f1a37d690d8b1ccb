import subprocess
import sys

_PROGRAM = """
import os, signal
signal.signal(signal.SIGTERM, lambda *_: print("handled", flush=True))
import panolog.prepare.check.bundle
import panolog.prepare.sfm.pipeline
os.kill(os.getpid(), signal.SIGTERM)
print("continues")
"""


def test_pycolmap_does_not_take_the_signal_by_which_a_run_is_stopped() -> None:
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["handled", "continues"]
    assert "Aborted" not in done.stderr
