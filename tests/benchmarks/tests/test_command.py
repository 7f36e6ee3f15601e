"""The commands of the benchmarks: each has its name in both places, and its own options."""

from __future__ import annotations

from benchmarks.__main__ import MODULES

from stage_service.cli.bench import BENCHMARKS


def test_every_name_of_the_command_line_has_a_module() -> None:
    assert {*MODULES, "all"} == set(BENCHMARKS)
