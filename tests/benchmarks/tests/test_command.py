"""The commands of the benchmarks: each has its name in both places, and its own options."""

from __future__ import annotations

import pytest
from benchmarks.__main__ import MODULES, main
from benchmarks.results import Panel, draw_panels, markdown, spread

from stage_service.cli.bench import BENCHMARKS


def test_every_name_of_the_command_line_has_a_module() -> None:
    assert {*MODULES, "all"} == set(BENCHMARKS)


@pytest.mark.parametrize(
    ("name", "own", "others"),
    [
        ("appearance", {"--seeds", "--capture", "--subject"}, {"--cache", "--only"}),
        ("light_codes", {"--cache", "--only"}, {"--seeds", "--capture", "--subject"}),
        ("all", {"--cache", "--only", "--seeds", "--capture", "--subject"}, set()),
    ],
)
def test_help_shows_only_a_benchmarks_own_options(name, own, others, capsys) -> None:
    with pytest.raises(SystemExit) as end:
        main([name, "--help"])
    assert end.value.code == 0
    words = set(capsys.readouterr().out.replace(",", " ").split())
    assert words >= {"--out", "--seed", "--quick", *own}
    assert not words & others


def test_a_benchmark_without_its_data_says_what_to_give(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.delenv("HAIRSTAGE_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    assert main(["agreement"]) == 1
    assert "--capture" in capsys.readouterr().err


def test_the_spread_of_one_seed_is_not_known() -> None:
    assert spread([2.0]) == {"mean": 2.0, "seeds": 1}
    assert spread([1.0, 3.0]) == pytest.approx({"mean": 2.0, "seeds": 2, "sd": 2**0.5})


def test_tables_and_curves_are_written(tmp_path) -> None:
    assert markdown(["a", "b"], [[1, "x"]]) == "| a | b |\n| --- | --- |\n| 1 | x |\n"
    linear = ("linear", "linear")
    panel = Panel("p", {"ours": [(1.0, 2.0, 0.1), (2.0, 1.0, 0.1)]}, "x", "y", linear)
    draw_panels(tmp_path / "p.png", [[panel, panel]])
    assert (tmp_path / "p.png").stat().st_size > 2000
