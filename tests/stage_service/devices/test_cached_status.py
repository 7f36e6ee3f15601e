"""What was seen last of devices and disk."""

from __future__ import annotations

import threading

from stage_service.devices.cached_status import CachedStatus


def test_status_is_queried_again_after_no_thread_could_start(monkeypatch):
    def none_left(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    observed = CachedStatus(lambda: {"free": 5}, {"free": None})
    with monkeypatch.context() as full:
        full.setattr(threading.Thread, "start", none_left)
        assert observed.get() == {"free": None, "age_s": None}
        assert observed.running_s() == 0
    assert observed.get()["free"] == 5
