"""A service that is started again lights nothing by itself, whoever waits for the stage."""

from __future__ import annotations

import signal

import httpx
import pytest
from waiting import until

from reconstruction.arrays import Bools

ENTRY = {"plan": {"lights": ["light_000"], "projectors": []}}


@pytest.mark.parametrize(
    "ended_by", [pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGKILL]
)
def test_lease_and_queue_outlast_a_restart(ended_by, simulated, serve):
    rig_file, world = simulated()
    service, http = serve(rig_file)
    granted = http.post("/lease", json={"holder": "Ada", "seconds": 3600}).json()
    ada = {"Hairstage-Lease": granted["token"]}
    release(http, ada)
    entry = http.post("/queue", json=ENTRY).json()["id"]
    assert "Ada" in http.get("/queue").json()["waits_for"]
    service.process.send_signal(ended_by)
    service.process.wait()

    _, http = serve(rig_file)
    put_on = count_lamps(world)
    assert http.get("/lease").json()["holder"] == "Ada"
    until(lambda: http.get("/health").json()["unread"] == 0)
    queue = http.get("/queue").json()
    assert [e["id"] for e in queue["waiting"]] == [entry]
    assert queue["held"].startswith("the service started")
    assert http.post("/captures", json=ENTRY).status_code == 409  # it is Ada's stage
    assert http.delete("/lease", headers=ada).status_code == 200
    # The lease has gone, the stage is dark and free: the hold alone keeps the entry waiting.
    until(lambda: http.get("/queue").json()["waits_for"] == f"held: {queue['held']}")
    assert http.get("/captures").json() == []
    assert put_on == []

    stale = http.post("/queue:go-on", json={"hold": "00000000"})
    assert stale.status_code == 409
    assert stale.json()["hold"] == queue["hold"]["id"]
    release(http)
    until(lambda: [c["outcome"] for c in http.get("/captures").json()] == ["completed"])
    assert put_on


def release(http: httpx.Client, headers: dict[str, str] | None = None) -> None:
    """Release the queue as somebody who has read why it is held."""
    hold = http.get("/queue").json()["hold"]["id"]
    response = http.post("/queue:go-on", json={"hold": hold}, headers=headers)
    assert response.status_code == 200, response.text


def count_lamps(world) -> list[int]:
    """The numbers of lamps lit, each time that lamps go on at the simulated bank."""
    lit: list[int] = []
    put = world.lamps._set

    def counted(wanted: Bools) -> None:
        if wanted.any():
            lit.append(int(wanted.sum()))
        put(wanted)

    world.lamps._set = counted
    return lit
