"""The camera link, and the frames that pulses lead to."""

from __future__ import annotations

import json
import threading
import time

import numpy as np
import pytest

from simulators.frames.responses import Response

BLACK, GAIN, EXPOSURE = 64, 50_000, 0.01


def expected(radiance):
    return BLACK + GAIN * EXPOSURE * radiance


def armed(bench, name="cam_a"):
    camera = bench.camera(name)
    assert camera.send(op="arm", exposure=EXPOSURE) == {"ok": True}
    return camera


def pulse(bench):
    assert bench.trigger.send("PULSE 10000").startswith("OK ")


def lit(image):
    """Mean counts of the pixels that see the subject in `Known`."""
    return image.reshape(-1, 3)[:100].mean()


def test_a_lamp_that_was_never_on_makes_a_dark_frame(bench):
    camera = armed(bench)
    pulse(bench)
    image = camera.frame().astype(float)
    assert image.mean() == pytest.approx(BLACK, abs=0.3)
    assert image.std() == pytest.approx(4.0 / 2.48, rel=0.2)  # read noise alone


def test_frames_follow_the_selected_lamp_and_its_level(bench):
    camera = armed(bench)
    bench.select(3)
    pulse(bench)
    bench.lights.write_register(2, 32768)
    pulse(bench)
    bench.select(0)
    pulse(bench)
    full, half, dark = camera.frame(), camera.frame(), camera.frame()
    assert lit(full) == pytest.approx(expected(0.3), rel=0.02)
    assert lit(half) == pytest.approx(expected(0.15), rel=0.02)
    assert lit(dark) == pytest.approx(BLACK, abs=0.5)
    assert full.reshape(-1, 3)[100:].mean() == pytest.approx(BLACK, abs=0.5)


def test_the_state_at_the_pulse_counts_not_the_state_at_the_reading(bench):
    camera = armed(bench)
    bench.select(1)
    pulse(bench)
    bench.select(65535)
    assert lit(camera.frame()) == pytest.approx(expected(0.1), rel=0.03)


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ({"op": "hello", "camera": "nobody"}, "cam_a"),
        ({"op": "arm", "exposure": 0}, "exposure"),
        ({"op": "arm", "exposure": "long"}, "exposure"),
        ({"op": "arm"}, "exposure"),
        ({"op": "zoom"}, "unknown op"),
        ([1, 2], "unknown op"),
    ],
)
def test_bad_requests_get_the_reason_as_reply(bench, request_, said):
    camera = bench.camera("cam_a")
    reply = camera.raw(json.dumps(request_).encode())
    assert reply["ok"] is False
    assert said in reply["error"]
    assert camera.send(op="read") == {"ok": True, "status": "empty"}


def test_bytes_that_are_not_json_are_an_error(bench):
    assert bench.camera("cam_a").raw(b"\xff{")["ok"] is False


class Slow:
    """A responder that waits for permission."""

    def __init__(self, known, gate):
        self.known, self.gate = known, gate

    def lights(self, camera):
        assert self.gate.wait(10)
        return self.known.lights(camera)


def test_busy_while_the_frame_is_rendered(start):
    gate = threading.Event()

    class Known:
        def lights(self, camera):
            return Response(np.arange(100), np.full((5, 100, 3), 0.5, np.float32))

    bench = start(responder=Slow(Known(), gate))
    camera = armed(bench)
    bench.select(1)
    pulse(bench)
    assert camera.send(op="read") == {"ok": True, "status": "busy"}
    begun = time.monotonic()
    assert bench.lights.read_input_registers(1).registers == [1]
    assert time.monotonic() - begun < 5  # of the 10 that the renderer waits
    gate.set()
    assert lit(camera.frame()) == pytest.approx(expected(0.5), rel=0.02)


def test_a_renderer_that_fails_is_the_cameras_error(start):
    class Broken:
        def lights(self, camera):
            raise RuntimeError("no libLLVM")

    bench = start(responder=Broken())
    camera = armed(bench)
    bench.select(1)
    pulse(bench)
    reply = camera.read()
    assert reply["ok"] is False
    assert "no libLLVM" in reply["error"]


def test_same_seed_same_bytes_and_another_seed_other_noise(start):
    def shoot(seed):
        bench = start(seed=seed)
        camera = armed(bench)
        bench.select(2)
        pulse(bench)
        pulse(bench)
        return camera.read()["payload"], camera.read()["payload"]

    assert shoot(1) == shoot(1)
    assert shoot(1)[0] != shoot(1)[1]
    assert shoot(1)[0] != shoot(2)[0]
