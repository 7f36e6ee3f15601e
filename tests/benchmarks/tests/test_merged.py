"""Table 1 of several runs."""

from __future__ import annotations

import json

import pytest
from benchmarks.appearance.merged import VARIANTS, figures_of, merged, read_results

from stage_service.cli.support.commands import BadArgument


def _variant(held: float, kept: bool | None, off: float) -> dict[str, object]:
    scores = {"psnr_clean": held, "ssim": 0.5}
    errors = {"beta_m_error": off, "beta_n_error": off, "gain_spread": 0.01}
    decision = {} if kept is None else {"decision": {"kept": kept}}
    groups = {"train views": {**scores, "psnr_clean": held + 1}, "held-out views": scores}
    return {**groups, **decision, **errors, "visible_sigma_a_error": off, "seconds": 2.0}


def _result(subject: str, ladder: str, seeds: int, only: tuple[str, ...] = ()) -> dict[str, object]:
    runs = {
        f"{ladder}, seed of the fit {k}": {
            name: _variant(20 + 2 * k, k == 0 if name == "spatial" else None, -0.25)
            for name in only or VARIANTS
        }
        for k in range(seeds)
    }
    rig = {"size": 128, "cameras": 10, "lights": 48}
    return {"subject": subject, "commit": "abc", "rig": rig, "subjects": runs}


def test_a_ladder_is_a_table_and_a_subject_a_column():
    without = tuple(x for x in VARIANTS if x not in ("full", "GaussianHair"))
    results = [_result("wavy", "r", 2), _result("curly", "r", 1), _result("wavy", "b", 1, without)]
    text = merged(results)
    assert "128²: 8 training, 2 held-out views" in text
    reconstructed, true = text.split("## ")[1:]
    lines = reconstructed.splitlines()
    assert lines[2] == "| variant | wavy, `abc` | curly, `abc` |"
    spatial = next(x for x in lines if "spatial" in x)
    assert spatial == (
        "| + spatial | 21.0 ± 1.4 / 22.0 / 0.50, 1 of 2 | 20.0 / 21.0 / 0.50, 1 of 1 |"
    )
    assert "| β_M off, in the end | -25, -25 % | -25 % |" in lines
    assert "| CPU s, Sun to lights | 10 | 10 |" in lines
    assert true.splitlines()[0] == "True strands"
    assert "full" not in true


def test_published_figures_are_those_of_the_tables():
    figures = figures_of(_result("wavy", "r", 1) | {"options": {"seed": 3}})
    assert set(figures) == {"subject", "commit", "subjects"}
    assert merged([figures | {"rig": {"size": 128, "cameras": 10, "lights": 48}}])


def test_files_that_are_no_runs_and_a_run_given_twice_are_refused(tmp_path):
    run, page, text = (tmp_path / name for name in ("run.json", "page.json", "text.json"))
    run.write_text(json.dumps(_result("wavy", "r", 1)))
    page.write_text(json.dumps({"figures": {}}))
    text.write_text("# a page")
    assert len(read_results([run])) == 1
    for path, reason in (
        (page, "it has no 'rig'"),
        (text, "Expecting value"),
        (tmp_path / "x", "No such"),
    ):
        with pytest.raises(BadArgument, match=f"{path.name}.*{reason}.*give appearance_SIZE.json"):
            read_results([path])
    with pytest.raises(BadArgument, match=r"ladder r of wavy at abc.*give one of them"):
        read_results([run, run])
