"""The simulated DMX widget as Debian's `olad` finds and drives it."""

from __future__ import annotations

import json
import os
import pwd
import re
import shutil
import socket
import subprocess
import tempfile
import urllib.error
import urllib.parse
import urllib.request
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from simulators.peers.dmx_widget import DmxWidget
from simulators.peers.lamps import Lamps

LAMPS = 331
OTHER_PLUGINS = [
    "artnet",
    "dmx4linux",
    "dummy",
    "e131",
    "espnet",
    "ftdidmx",
    "gpio",
    "karate",
    "kinet",
    "milinst",
    "nanoleaf",
    "opendmx",
    "openpixelcontrol",
    "osc",
    "pathport",
    "renard",
    "sandnet",
    "shownet",
    "spi",
    "stageprofi",
    "uartdmx",
    "usbdmx",
]


def free_ports(count):
    with ExitStack() as stack:
        listeners = [stack.enter_context(socket.create_server(("", 0))) for _ in range(count)]
        return [listener.getsockname()[1] for listener in listeners]


class Olad:
    """A running `olad` that has the widget as its one device."""

    def __init__(self, folder, stack):
        program = shutil.which("olad")
        if program is None:
            pytest.skip("olad is missing: apt-get install ola")
        # It refuses to run as root, and must be able to read what root makes here.
        user = None if os.geteuid() else _somebody()
        configuration, devices = folder / "configuration", folder / "devices"
        for made in (folder, configuration, devices):
            made.mkdir(exist_ok=True)
            made.chmod(0o755 if made is folder else 0o777)
        for plugin in OTHER_PLUGINS:
            (configuration / f"ola-{plugin}.conf").write_text("enabled = false\n")
        (configuration / "ola-usbserial.conf").write_text(
            f"enabled = true\ndevice_dir = {devices}\ndevice_prefix = lights\n"
        )
        for file in configuration.iterdir():
            file.chmod(0o666)
        self.lamps = Lamps(LAMPS)
        widget = DmxWidget(self.lamps, 1, devices / "lights")
        link = Path(widget.start())
        stack.callback(widget.stop)
        link.chmod(0o666)
        rpc, self.http = free_ports(2)
        log = stack.enter_context((folder / "log").open("w"))
        process = subprocess.Popen(
            [
                *(program, "-c", configuration, "-r", str(rpc), "-p", str(self.http)),
                *("-i", "lo", "-l", "3", "--no-register-with-dns-sd"),
            ],
            stdout=log,
            stderr=log,
            user=user,
            extra_groups=None if user is None else [],
        )
        stack.callback(process.wait, 10)
        stack.callback(process.terminate)
        self.log = folder / "log"

    def ask(self, path, **form):
        data = urllib.parse.urlencode(form).encode() if form else None
        try:
            with urllib.request.urlopen(
                f"http://127.0.0.1:{self.http}/{path}", data, timeout=5
            ) as answer:
                return answer.read().decode()
        except urllib.error.URLError:
            return None

    def output(self):
        """The widget's output port, once it is found."""
        ports = json.loads(self.ask("json/get_ports") or "[]")
        return next((p for p in ports if p["is_output"]), None)


def _somebody():
    for name in ("olad", "nobody"):
        try:
            return pwd.getpwnam(name).pw_uid
        except KeyError:
            pass
    pytest.skip("olad refuses to run as root, and there is no user olad or nobody")


def test_olad_finds_the_widget_and_lights_its_lamps():
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="olad")))
        olad = Olad(folder, stack)
        port = until(olad.output)
        assert re.search(r"Serial #: 12345678", port["device"])
        made = olad.ask("new_universe", id=1, name="stage", add_ports=port["id"])
        assert json.loads(made)["ok"]
        levels = [(7 * lamp) % 256 for lamp in range(LAMPS)]
        assert olad.ask("set_dmx", u=1, d=",".join(map(str, levels))) == "ok"
        until(lambda: olad.lamps.power()[-1])
        np.testing.assert_allclose(olad.lamps.power(), np.array(levels) / 255)
        assert olad.ask("set_dmx", u=1, d=",".join("0" * LAMPS)) == "ok"
        until(lambda: not olad.lamps.power().any())
