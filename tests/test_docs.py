"""The pages must fit the house: commands, options, files and names that they give are there."""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import runpy
import shlex
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from benchmarks.__main__ import MODULES
from benchmarks.publish import page_of

from appearance.render.harmonics import projected
from stage_service.cli import build_parser

ROOT = Path(__file__).resolve().parents[1]
MADE_BY_DOCS = {"generated", "_build"}
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "THIRD_PARTY.md")),
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if p.parent.name not in MADE_BY_DOCS),
]
FLOORS = ("reconstruction", "appearance", "stage_service", "simulators")
ROOMS = [ROOT, ROOT / "tests", *(ROOT / floor for floor in FLOORS)]
MADE = {"runs/", "build/"}
"""Folders that commands make."""
CODE = re.compile(r"`([^`]+)`")


def blocks(page: Path) -> Iterator[str]:
    """Commands that stand on lines of their own, whole."""
    joined = page.read_text().replace("\\\n", " ")
    yield from re.findall(r"^ {4}(hairstage .*)$", joined, re.MULTILINE)


def mentions(page: Path) -> Iterator[str]:
    """Code within a sentence that begins with the program's name; arguments may be left out."""
    for code in CODE.findall(page.read_text()):
        if (text := " ".join(code.split())).startswith("hairstage "):
            yield text


def words(command: str) -> list[str]:
    """The arguments; brackets around optional ones and the dots of many are for people."""
    return shlex.split(re.sub(r"[\[\]]|\.\.\.", "", command), comments=True)[1:]


def actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Those of `parser` and of all of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from actions(command)


@cache
def lenient() -> argparse.ArgumentParser:
    """The command line, with nothing required."""
    parser = build_parser()
    for action in actions(parser):
        action.required = False
        if not action.option_strings and not isinstance(action, argparse._SubParsersAction):
            action.nargs = {None: "?", "+": "*"}.get(action.nargs, action.nargs)
    return parser


def parses(parser: argparse.ArgumentParser, command: str) -> bool:
    try:
        parser.parse_args(words(command))
    except SystemExit as end:
        return end.code == 0  # --help
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_on_the_pages_are_there(page: Path) -> None:
    assert [c for c in blocks(page) if not parses(build_parser(), c)] == []
    assert [c for c in mentions(page) if not parses(lenient(), c)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_options_and_modules_on_the_pages_are_there(page: Path) -> None:
    parsers = [build_parser(), argparse.ArgumentParser()]
    for name in MODULES:
        import_module(MODULES[name]).BENCHMARK.add_options(parsers[1])
    options = {name for p in parsers for action in actions(p) for name in action.option_strings}
    named = re.findall(r"`(--[a-z][a-z-]*)", page.read_text())
    assert sorted(set(named) - options) == []
    modules = re.findall(r"`python -m ([a-z_.0-9]+)", page.read_text())
    assert [m for m in modules if importlib.util.find_spec(m) is None] == []


def paths(page: Path) -> Iterator[str]:
    """Code that reads as a path of the repository: a folder's or a module's, from any floor on."""
    for code in CODE.findall(page.read_text()):
        if re.fullmatch(r"[a-z_0-9.]+(/[A-Za-z_0-9.-]+)*/?", code) and (
            code.endswith((".py", "/")) or code.split("/")[0] in {*FLOORS, "tests", "deploy"}
        ):
            yield code


def is_there(path: str, rooms: list[Path]) -> bool:
    return any((room / path).exists() for room in rooms) or any(path.startswith(m) for m in MADE)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_paths_on_the_pages_are_there(page: Path) -> None:
    """From the root, from a floor or from a room on."""
    inside = [p for floor in FLOORS for p in (ROOT / floor).rglob("*") if p.is_dir()]
    others = {"images/", "masks/", "plots/", "capture/", "model/", "truth/", "logs/"}
    others |= {"captures/", "models/", "trash/", "uploads/"}
    absent = [p for p in paths(page) if p not in others and not is_there(p, [*ROOMS, *inside])]
    assert absent == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_on_the_pages_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text())
    local = [link for link in links if "://" not in link and "generated/" not in link]
    assert [link for link in local if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_lines_of_the_pages_are_not_too_long(page: Path) -> None:
    lines = re.sub(r"\]\([^)\s]*\)", "]", page.read_text()).splitlines()  # a link does not break
    made = page.parent.name == "benchmarks"
    # a table's rows do not break, and what a command wrote is not for editors
    most = [999 if line.startswith("|") or made else 120 for line in lines]
    long = [k for k, line in enumerate(lines) if len(line) > most[k]]
    assert [f"{k + 1}: {lines[k]}" for k in long] == []


def test_a_page_of_figures_is_what_its_json_says() -> None:
    records = sorted((ROOT / "docs" / "benchmarks").glob("*.json"))
    assert len(records) >= 10
    for path in records:
        page = page_of(json.loads(path.read_text()))
        assert path.with_suffix(".md").read_text() == page, path.name


@pytest.mark.parametrize(
    "wrong",
    [
        "hairstage reconstrukt capture",
        "hairstage bench everything",
        "hairstage fit capture model --light_planes",
        "hairstage evaluate geometry a b c",
    ],
)
def test_a_wrong_command_would_be_noticed(wrong: str) -> None:
    assert not parses(lenient(), wrong)
    assert not parses(build_parser(), wrong)


def test_the_pages_have_commands() -> None:
    assert sum(len(list(blocks(p))) for p in PAGES) >= 10
    assert sum(len(list(mentions(p))) for p in PAGES) >= 15


def test_every_test_that_the_page_of_hazards_names_is_there():
    page = (ROOT / "docs" / "reference" / "hazards.md").read_text()
    named = set(re.findall(r"`(tests/[^`]+)`", page))
    assert len(named) > 10
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_an_environment_maps_column_is_the_renderers() -> None:
    """Light from the face's direction, where the figure marks it, has y = −1 in the renderer."""
    figures = runpy.run_path(str(ROOT / "docs" / "figures.py"))
    for direction in figures["AXES"].values():
        sky = np.zeros((64, 128, 3))
        sky[31:33, int(figures["column_of"](direction) * 128) % 128] = 1.0
        _, y, z, x = projected(sky, 0.0, 1)[:, 0]
        found = np.array([x, y, z]) / np.linalg.norm([x, y, z])
        assert found @ direction > 0.99
