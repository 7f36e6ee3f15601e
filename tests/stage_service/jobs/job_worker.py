"""A worker whose steps are quick stand-ins: `python job_worker.py ROOT`. Run by test_jobs."""

import os
import sys
import time
from pathlib import Path

from stage_service.jobs import steps, worker
from stage_service.jobs.worker import run_worker


def _log(context: steps.StepContext, line: str) -> None:
    with (context.model.path / "log.txt").open("a") as file:
        file.write(line + "\n")


def first(context: steps.StepContext) -> steps.Figures:
    _log(context, "first")
    return {"answer": 42}


def slow(context: steps.StepContext) -> steps.Figures:
    """Goes on until the file `go` is there; tells its progress as real steps do, but where the
    file `deaf` is: as native code that takes long."""
    _log(context, "slow begins")
    while (context.model.path / "deaf").exists():
        time.sleep(0.02)
    while not (context.model.path / "go").exists():
        time.sleep(0.02)
        try:
            context.progress("waiting", 0.5)
        except Exception:
            _log(context, "swallowed")
    _log(context, f"slow ends, first said {context.previous['reconstruct']['figures']['answer']}")
    return {}


def last(context: steps.StepContext) -> steps.Figures:
    _log(context, "last")
    return {}


def bad(context: steps.StepContext) -> steps.Figures:
    """Fails, as often as the file `fails` says or always; says beside the models that it began."""
    with (context.model.path.parent / "order.txt").open("a") as file:
        file.write(context.model.path.name + "\n")
    fails = context.model.path / "fails"
    left = int(fails.read_text()) if fails.exists() else 1
    if left == 0:
        return {}
    if fails.exists():
        fails.write_text(str(left - 1))
    raise ValueError("this capture has no frames")


def light(context: steps.StepContext) -> steps.Figures:
    """Says which process began and ended it, of which root."""
    who = f"{os.getpid()} {sys.argv[1]}"
    _log(context, f"begins {who}")
    time.sleep(0.05)
    _log(context, f"ends {who}")
    return {}


if __name__ == "__main__":
    worker.CANCEL_S = 1.0
    worker.LOOK_S = worker.RETRY_S = 0.2
    steps.STEPS.update(
        reconstruct=first, evaluate=slow, results=last, fit=bad, relight=last, assess=last
    )
    steps.STEPS.update(inverse_rendering=last, fields=last)  # also of a light worker
    if "light" in sys.argv:
        steps.STEPS.update(
            reconstruct=light, evaluate=light, fit=light, relight=light, assess=light
        )
    run_worker(Path(sys.argv[1]), gpu="gpu" in sys.argv, ready=lambda name: print(name, flush=True))
