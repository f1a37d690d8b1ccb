"""The process of one step: `python -m benchmarks.first_hour.step CONTEXT`, started by `supervise`."""

import ctypes
import importlib
import json
import os
import signal
import sys
from types import FrameType

from benchmarks.first_hour.outcome import NO_CARD, Context, Outcome
from benchmarks.first_hour.steps import STEPS

_PR_SET_PDEATHSIG = 1  # of prctl(2)


def _end_group(_number: int, _frame: FrameType | None) -> None:
    os.killpg(0, signal.SIGKILL)


def end_together() -> None:
    """What the step has started ends with it, and it ends with the program, should that be killed."""
    signal.signal(signal.SIGTERM, _end_group)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def main() -> int:
    """Runs the step that the argument describes and leaves its result; its exit code is 1 if it raises."""
    context = Context(**json.loads(sys.argv[1]))
    end_together()
    context.save(_work(context))
    return 0


def _work(context: Context) -> Outcome:
    step = STEPS[context.step]
    needs_card = step.card or (context.cuda and context.step != "machine")
    if needs_card and not (context.cuda and _has_card()):
        return Outcome("skipped", reason=NO_CARD)
    outcome: Outcome = getattr(
        importlib.import_module(f"benchmarks.first_hour.{step.module}"), step.function
    )(context)
    return outcome


def _has_card() -> bool:
    import torch  # noqa: PLC0415  # the machine's step reports a torch that does not load

    return torch.cuda.is_available()


if __name__ == "__main__":
    sys.exit(main())
