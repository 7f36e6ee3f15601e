"""CPU and GPU side by side: processes of their own, failures that are told, what is compared."""

from __future__ import annotations

import json
import os
from functools import partial

import drjit as dr
import numpy as np
import pytest
from benchmarks.__main__ import main
from benchmarks.backends import jobs
from benchmarks.backends.jobs import Done
from benchmarks.backends.side_by_side import compared, done_by

from reconstruction.array_backend import VARIANT, prefer_cuda

LLVM, CUDA = "llvm_ad_rgb", "cuda_ad_rgb"
needs_gpu = pytest.mark.skipif(
    not dr.has_backend(dr.JitBackend.CUDA), reason="no CUDA device; LLVM's part runs"
)


def found(*values: float) -> Done:
    return Done(1.0, 1.0, np.array(values, np.float32), {})


def test_common_values_are_compared_and_missing_ones_are_counted() -> None:
    nan = float("nan")
    said = compared(found(1.0, 2.0, nan, 4.0, nan), found(1.0, 2.0001, 3.0, nan, nan))
    assert said["only_one"] == pytest.approx(2 / 4)
    assert said["near"] == 1
    assert said["mean"] == pytest.approx(0.0001 / 3, rel=1e-2)
    assert said["rms"] == pytest.approx(0.0001 / 5**0.5, rel=1e-2)
    assert compared(found(nan), found(nan)) == {"only_one": 0.0}
    with pytest.raises(ValueError, match=r"\(2,\) numbers"):
        compared(found(1.0, 2.0), found(1.0))


@needs_gpu
def test_the_bsdf_is_the_same_on_a_gpu() -> None:
    one, other = (done_by(v, partial(jobs.bsdf, 2000, 3)) for v in (LLVM, CUDA))
    assert compared(one, other)["rms"] < 1e-5


@pytest.mark.slow
def test_a_quick_run_leaves_what_the_cpu_does_and_says_what_is_not_here(tmp_path, capsys) -> None:
    assert main(["backends", "--quick", "--jobs", "bsdf", "--out", str(tmp_path)]) == 0
    (job,) = json.loads((tmp_path / "backends.json").read_text())["jobs"].values()
    assert job[LLVM]["seconds"] > 0
    page = (tmp_path / "backends.md").read_text()
    assert f"{len(os.sched_getaffinity(0))} threads" in page
    assert (CUDA in job) != (f"{CUDA}: not here" in page)


@pytest.mark.slow
@pytest.mark.parametrize("variant", [LLVM, CUDA])
def test_a_job_runs_in_a_process_of_its_own_whose_variant_it_is(variant, monkeypatch) -> None:
    monkeypatch.setenv(VARIANT, "mine")
    assert done_by(variant, _reports).figures == {variant: 1}
    assert os.environ[VARIANT] == "mine"


def _reports() -> Done:
    return Done(0, 0, np.zeros(0, np.float32), {os.environ[VARIANT]: 1})


def test_a_worker_takes_a_gpu_where_there_is_one_and_nothing_else_was_chosen(monkeypatch) -> None:
    monkeypatch.setenv(VARIANT, LLVM)
    assert not prefer_cuda()
    assert os.environ[VARIANT] == LLVM
    for there in (False, True):
        monkeypatch.setenv(VARIANT, "")
        monkeypatch.setattr(dr, "has_backend", lambda backend, there=there: there)
        assert prefer_cuda() == there
        assert os.environ[VARIANT] == (CUDA if there else "")
