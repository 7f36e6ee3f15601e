"""The pages must fit the command line: commands and options that they name are there."""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from stage_service.cli import build_parser

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
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
    options = {name for action in actions(build_parser()) for name in action.option_strings}
    named = re.findall(r"`(--[a-z][a-z-]*)", page.read_text())
    assert sorted(set(named) - options) == []
    modules = re.findall(r"`python -m ([a-z_.0-9]+)", page.read_text())
    assert [m for m in modules if importlib.util.find_spec(m) is None] == []


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
