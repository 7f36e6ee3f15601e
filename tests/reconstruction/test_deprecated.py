"""Old names of keys are read, reported once and refused beside the new name."""

import logging
import re
from pathlib import Path

import pytest

from reconstruction import deprecated
from reconstruction.deprecated import RENAMED, BothNamesError, with_new_names

PAGE = Path(__file__).parents[2] / "docs/reference/files.md"


@pytest.fixture(autouse=True)
def table(monkeypatch):
    """A table of its own; no warning was logged yet."""
    monkeypatch.setattr(deprecated, "RENAMED", {"rig.toml": {"old": "new"}})
    deprecated._warn.cache_clear()
    yield
    deprecated._warn.cache_clear()


def test_old_keys_are_replaced_with_one_warning_that_names_both(caplog):
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert with_new_names("rig.toml", {"old": 1, "b": 2}) == {"new": 1, "b": 2}
    assert [r.args[:3] for r in caplog.records] == [("rig.toml", "old", "new")]
    assert with_new_names("another", {"old": 1}) == {"old": 1}


def test_both_names_together_are_refused():
    with pytest.raises(BothNamesError, match=r"rig\.toml.*'old'.*'new'"):
        with_new_names("rig.toml", {"old": 1, "new": 1})


def test_the_reference_lists_the_table():
    section = PAGE.read_text(encoding="utf-8").partition("## Old names")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (.+?) \| `(.+?)` \| `(.+?)` \|$", section, re.MULTILINE)
    assert sorted(rows) == sorted(
        (kind, old, new) for kind, names in RENAMED.items() for old, new in names.items()
    )
