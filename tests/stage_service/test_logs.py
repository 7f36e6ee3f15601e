"""What comes again and again is a line when it begins, one a minute, and one when it is over."""

from __future__ import annotations

import logging

import pytest

from stage_service.records import logs
from stage_service.records.logs import MOST_CAUSES, Causes, Folded

log = logging.getLogger("hairstage.tests")


@pytest.fixture
def lines(caplog):
    caplog.set_level(logging.INFO)
    return lambda: [record.message for record in caplog.records]


@pytest.fixture
def now():
    return [1000.0]


@pytest.fixture
def causes(now):
    return Causes(lambda: now[0])


def test_a_cause_that_lasts_is_a_line_a_minute_with_its_count(causes, now, lines):
    for second in range(150):
        now[0] = 1000.0 + second
        causes.failed(log, "the disk", "no space left")
        causes.failed(log, "camera 3", f"no answer at {second}")
    causes.over(log, "the disk")
    causes.over(log, "the disk")
    causes.over(log, "camera 4")
    assert lines() == [
        "the disk: no space left",
        "camera 3: no answer at 0",
        "the disk: no space left (60 times, and for 60 s now)",
        "camera 3: no answer at 60 (60 times, and for 60 s now)",
        "the disk: no space left (60 times, and for 120 s now)",
        "camera 3: no answer at 120 (60 times, and for 120 s now)",
        "the disk: over after 149 s (it came 150 times)",
    ]


def test_causes_without_end_are_not_kept(causes):
    for number in range(3 * MOST_CAUSES):
        causes.failed(log, f"cause {number}", "x")
    assert len(causes._causes) == MOST_CAUSES


def test_the_failures_that_a_library_logs_are_counted_as_their_cause(causes, monkeypatch):
    monkeypatch.setattr(logs, "CAUSES", causes)
    kept: list[str] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            kept.append(f"{record.name}: {record.getMessage()}")

    handler = Kept()
    handler.addFilter(Folded(log, "the database", {"library"}, {"psycopg", "connection"}))
    loggers = [logging.getLogger(name) for name in ("library.pool", "another", log.name)]
    for one in loggers:
        one.addHandler(handler)
    try:
        for _ in range(50):
            loggers[0].warning("Exception in a thread: (psycopg.OperationalError) no\nTraceback …")
            loggers[0].error("lost", exc_info=ConnectionError())
        loggers[0].warning("a queue has two names")
        loggers[1].warning("connection lost")
    finally:
        for one in loggers:
            one.removeHandler(handler)
    assert kept == [
        "hairstage.tests: the database: Exception in a thread: (psycopg.OperationalError) no",
        *50 * ["library.pool: lost"],  # of another kind
        "library.pool: a queue has two names",
        "another: connection lost",
    ]
    assert causes._causes["the database"].count == 50
