"""What the listener does with connections, whatever comes over them."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import httpx
import pytest
import uvicorn
from waiting import until

from stage_service.api import connections
from stage_service.api.connections import limits, listening
from stage_service.api.places import Places

REQUEST = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
SLOW = b"POST /slow HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\nx"
HALF = b"GET / HTTP/1.1\r\nHost: x\r\nX: "


@pytest.fixture
def connect(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[bytes], socket.socket]]:
    """`connect(data)`: a connection to a server whose hall has three places, over which `data` was
    sent."""

    async def app(scope, receive, send):
        while scope["path"] == "/slow" and (await receive()).get("more_body"):
            pass
        await send({"type": "http.response.start", "status": 200, "headers": []})
        while scope["path"] == "/stay" and (await receive())["type"] != "http.disconnect":
            pass
        await send({"type": "http.response.body", "body": b"hello"})

    monkeypatch.setattr(connections, "HALL", 3)
    options = limits(Places())
    server = uvicorn.Server(uvicorn.Config(app, log_level="critical", lifespan="off", **options))
    listener = listening()
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    until(lambda: server.started)
    opened = []

    def connect(data: bytes) -> socket.socket:
        one = socket.create_connection(listener.getsockname(), timeout=60)
        opened.append(one)
        one.sendall(data)
        return one

    yield connect
    for one in opened:
        one.close()
    server.should_exit = True
    thread.join(30)
    listener.close()


def ended(connection: socket.socket) -> bool:
    """Waits until the server has ended it; what it said before that is read."""
    try:
        while connection.recv(4096):
            pass
    except ConnectionResetError:
        pass
    return True


@pytest.mark.parametrize("data", [b"", HALF, SLOW])
def test_idle_connections_keep_no_client_out(connect, data):
    held = [connect(data) for _ in range(9)]
    assert connect(REQUEST).recv(12) == b"HTTP/1.1 200"
    assert all(ended(one) for one in held[:6])


def test_a_request_under_way_keeps_its_place(connect):
    streams = [connect(REQUEST.replace(b"/ ", b"/stay ")) for _ in range(3)]
    assert [one.recv(12) for one in streams] == 3 * [b"HTTP/1.1 200"]
    assert connect(REQUEST).recv(12) == b"HTTP/1.1 503"
    streams[0].close()
    until(lambda: connect(REQUEST).recv(12) == b"HTTP/1.1 200")


@pytest.mark.parametrize("data", [b"", b"G", HALF, REQUEST + HALF])
def test_headers_have_a_deadline(connect, data, monkeypatch):
    monkeypatch.setattr(connections, "HEADER_S", 0.05)
    assert ended(connect(data))


def test_headers_have_a_size(connect):
    assert connect(HALF + (17 << 10) * b"a").recv(12) == b"HTTP/1.1 400"


def test_a_unix_socket_is_for_user_and_group(tmp_path):
    path = tmp_path / "s"
    with listening(unix=path) as listener:
        assert path.stat().st_mode & 0o777 == 0o660
        listener.listen()
        with pytest.raises(OSError, match="another service"):
            listening(unix=path)
    listening(unix=path).close()  # the one before has died


def test_a_burst_of_connections_leaves_descriptors_too(rig_file, tmp_path):
    """More at once than the process may have files, each with half a request."""
    command = [sys.executable, "-m", "stage_service.cli", "serve", "--json", "--port", "0"]
    command += ["--no-auth", "--rig", str(rig_file.path), "--root", str(tmp_path / "root")]
    errors = tmp_path / "errors"
    own = resource.getrlimit(resource.RLIMIT_NOFILE)
    if own[1] < 4096:
        pytest.skip("this process may not open 1,224 connections")
    with ExitStack() as stack, errors.open("w") as log:
        few = "import os, resource, sys; resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))"
        service = subprocess.Popen(
            [sys.executable, "-c", f"{few}; os.execv(sys.argv[1], sys.argv[1:])", *command],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        stack.callback(lambda: (service.kill(), service.wait(), service.stdout.close()))
        url = json.loads(service.stdout.readline())["url"]
        resource.setrlimit(resource.RLIMIT_NOFILE, (4096, own[1]))
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, own)
        address = (httpx.URL(url).host, httpx.URL(url).port)
        os.kill(service.pid, signal.SIGSTOP)  # it finds them all at once
        for _ in range(1000):
            stack.enter_context(socket.create_connection(address)).sendall(HALF)
        os.kill(service.pid, signal.SIGCONT)
        for _ in range(224):
            stack.enter_context(socket.create_connection(address)).sendall(HALF)
        with httpx.Client(trust_env=False, timeout=60) as http:
            assert http.get(f"{url}/health").status_code == 200
        assert "Too many open files" not in errors.read_text()


@pytest.mark.parametrize("host", ["::1", pytest.param("[::1]", marks=pytest.mark.slow)])
def test_serve_responds_on_ipv6_loopback_to_names_in_any_case(rig_file, tmp_path, host):
    command = [sys.executable, "-m", "stage_service.cli", "serve", "--json", "--port", "0"]
    command += ["--rig", str(rig_file.path), "--root", str(tmp_path / "root"), "--no-auth"]
    command += ["--host", host, "--name", "Stage-PC"]
    service = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert service.stdout is not None
        url = json.loads(service.stdout.readline())["url"]
        assert url.startswith("http://[::1]:")
        with httpx.Client(base_url=url, trust_env=False, timeout=60) as http:
            assert http.get("/health").json()["status"] == "ok"
            for name in ("stage-pc", "Stage-PC", "STAGE-PC:80"):  # browsers send the first
                assert http.get("/health", headers={"Host": name}).status_code == 200
            assert http.get("/health", headers={"Host": "stage"}).status_code == 421
        service.terminate()
        assert service.wait(60) == 0
    finally:
        service.kill()
        service.wait()
        service.stdout.close()


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl here")
def test_serve_with_a_certificate_accepts_only_tls(rig_file, tmp_path):
    """The command itself, from its first line to SIGTERM."""
    key, certificate = tmp_path / "key.pem", tmp_path / "cert.pem"
    made = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"]
    names = ["-subj", "/CN=stage", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"]
    into = ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*made, *names, *into], check=True, capture_output=True)
    command = [sys.executable, "-m", "stage_service.cli", "serve", "--json", "--port", "0"]
    command += ["--rig", str(rig_file.path), "--root", str(tmp_path / "root")]
    command += ["--tls-cert", str(certificate), "--tls-key", str(key)]
    environment = {**os.environ, "HAIRSTAGE_TOKEN_FILE": str(tmp_path / "token")}
    service = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    )
    try:
        assert service.stdout is not None
        url = json.loads(service.stdout.readline())["url"]
        assert url.startswith("https://127.0.0.1:")
        token = {"Authorization": f"Bearer {(tmp_path / 'token').read_text().strip()}"}
        trusted = ssl.create_default_context(cafile=certificate)
        with httpx.Client(verify=trusted, trust_env=False, timeout=60) as http:
            assert http.get(f"{url}/health", headers=token).json()["status"] == "ok"
            assert http.get(f"{url}/health").status_code == 401
            with pytest.raises(httpx.HTTPError):
                http.get(url.replace("https", "http") + "/health", headers=token)
        service.terminate()
        assert service.wait(60) == 0
    finally:
        service.kill()
        service.wait()
        service.stdout.close()
