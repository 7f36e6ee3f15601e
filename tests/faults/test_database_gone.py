"""PostgreSQL that is gone for more than a minute: a line a minute, and jobs once it is back."""

from __future__ import annotations

import time

import pytest
from postgresql import Missing, PostgreSQL, running
from waiting import until

GONE_S = 75.0


@pytest.fixture
def postgresql(stack) -> PostgreSQL:
    try:
        return stack.enter_context(running())
    except Missing as missing:
        pytest.skip(str(missing))


@pytest.mark.slow
def test_a_database_that_is_gone_fills_no_log(process, simulated, serve, postgresql, tmp_path):
    """A service and its worker wrote 3,137 lines in 24 s. Jobs are read all the time meanwhile."""
    rig_file, _ = simulated()
    database = {"HAIRSTAGE_DATABASE_URL": postgresql.url}
    _, client = serve(rig_file, **database)
    words = ("-m", "stage_service.cli", "worker", "--json", "--root", tmp_path / "root")
    process(tmp_path / "worker.log", *words, **database)
    assert client.get("/jobs").status_code == 200
    logs = [tmp_path / name for name in ("serve.log", "worker.log")]
    before = [len(log.read_text().splitlines()) for log in logs]
    postgresql.stop()
    try:
        end = time.monotonic() + GONE_S
        statuses = set()
        while time.monotonic() < end:
            statuses.add(client.get("/jobs").status_code)
            time.sleep(0.2)
        lines = [log.read_text().splitlines()[n:] for log, n in zip(logs, before, strict=True)]
    finally:
        postgresql.start()
    assert 503 in statuses
    assert statuses <= {200, 503}
    for new in lines:  # two minutes have begun, for at most two causes
        assert 1 <= len(new) <= 4, new
    until(lambda: client.get("/jobs").status_code == 200)
