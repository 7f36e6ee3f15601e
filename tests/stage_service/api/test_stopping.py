"""A service that was told to stop answers until everything has been closed."""

from __future__ import annotations

import logging
import signal
import threading
from types import SimpleNamespace

import httpx
import uvicorn

from stage_service import service as services
from stage_service.api import app
from stage_service.api.connections import limits, listening
from stage_service.service import Service


def test_blackout_and_health_respond_while_the_service_stops(
    rig_file, world, tmp_path, monkeypatch
):
    service, closing, go = (
        Service(rig_file, tmp_path / "root"),
        threading.Event(),
        threading.Event(),
    )
    close = service.calibrating.close

    def held() -> None:
        closing.set()
        go.wait()
        close()

    monkeypatch.setattr(service.calibrating, "close", held)
    monkeypatch.setattr(services, "OTHERS_S", 600.0)
    ending = SimpleNamespace(left=[], by=lambda _seconds: None)
    monkeypatch.setattr(app, "Ending", lambda _left, _doing: ending)
    made = app.create_app(service)
    places = made.state.places
    config = uvicorn.Config(made, log_level="error", timeout_graceful_shutdown=1, **limits(places))
    up, log = threading.Event(), logging.getLogger("uvicorn.error")
    with listening() as listener:
        server = app._Server(config, made, service, up.set)
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        level = log.level
        try:
            up.wait()
            url = f"http://127.0.0.1:{listener.getsockname()[1]}"
            with httpx.Client(base_url=url, timeout=60, trust_env=False) as http:
                server.handle_exit(signal.SIGTERM, None)
                closing.wait()
                health = http.get("/health").json()
                message = "the service is stopping and lights nothing"
                assert (health["status"], health["problems"]) == ("degraded", [message])
                assert http.post("/captures", json={}).status_code == 409
                world.lit = {3}
                assert http.post("/devices/blackout").json()["state"] == "dark"
                assert world.lit == set()
        finally:
            go.set()
            thread.join(60)
            log.setLevel(level)
    assert service.not_ended == []
    assert not thread.is_alive()
