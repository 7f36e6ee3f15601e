"""What deploy/ offers to install must fit the command line and the rig files that come with it."""

from __future__ import annotations

import configparser
import ipaddress
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from stage_service.cli import build_parser
from stage_service.cli.support.commands import rig_path
from stage_service.config import load_rig_file

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
MOST_EXPOSED = 3.0
UNITS = pytest.mark.parametrize(
    "unit", sorted((DEPLOY / "systemd").glob("*.service")), ids=lambda p: p.name
)


@UNITS
@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
def test_units_are_sound_and_confined(unit, tmp_path):
    """By systemd's own judgement: 10 is a unit without any confinement."""
    copy = tmp_path / unit.name
    copy.write_text(unit.read_text().replace("/opt/hairstage/.venv/bin/hairstage", "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    command = ["systemd-analyze", "security", "--offline=yes", "--no-pager", copy]
    said = subprocess.run(command, capture_output=True, text=True).stdout
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", said)
    assert found, said
    assert float(found[1]) <= MOST_EXPOSED


@UNITS
def test_units_start_commands_that_there_are(unit):
    read = configparser.ConfigParser(strict=False, interpolation=None)
    read.optionxform = str
    read.read(unit)
    program, *arguments = shlex.split(read["Service"]["ExecStart"])
    assert Path(program).name == "hairstage"
    parsed = build_parser().parse_args(arguments)
    assert str(parsed.root) == "/var/lib/hairstage"


def test_the_service_may_look_for_cameras_and_talk_to_them():
    """GigE Vision finds devices by a broadcast to 255.255.255.255 (GVCP, DISCOVERY_CMD), which
    answer from the stage's network, or from link-local addresses while nobody gives them others."""
    unit = (DEPLOY / "systemd" / "hairstage.service").read_text()
    assert "IPAddressDeny=any" in unit
    names = {"localhost": "127.0.0.0/8", "link-local": "169.254.0.0/16"}  # systemd's, of IPv4
    said = " ".join(re.findall(r"^IPAddressAllow=(.*)$", unit, re.MULTILINE)).split()
    networks = [ipaddress.ip_network(names.get(word, word)) for word in said]
    for address in ("255.255.255.255", "169.254.3.4", "192.168.3.4", "127.0.0.1"):
        assert any(ipaddress.ip_address(address) in network for network in networks), address
    assert not any(ipaddress.ip_address("8.8.8.8") in network for network in networks)


def test_containers_start_commands_that_there_are_on_files_that_there_are():
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    image = (DEPLOY / "Containerfile").read_text()
    own = json.loads(re.findall(r"^CMD (.*)$", image, re.MULTILINE)[0])
    started = {k: s["command"] for k, s in compose["services"].items() if "command" in s}
    assert set(started) == {"service", "worker"}
    for command in (own, *started.values()):
        assert str(build_parser().parse_args(command).root) == "/var/lib/hairstage"
    for copied in re.findall(r"^COPY (.*) \S+$", image, re.MULTILINE):
        assert all((DEPLOY.parent / name).exists() for name in copied.split())
    build = compose["services"]["service"]["build"]
    assert (DEPLOY / build["context"] / build["dockerfile"]).samefile(DEPLOY / "Containerfile")
    rules = (DEPLOY / "udev" / "70-hairstage.rules").read_text()
    for device in compose["services"]["service"]["devices"]:
        assert f'SYMLINK+="{Path(device).name}"' in rules


def test_serial_ports_belong_to_a_group_that_a_container_has_too():
    """One that only the host has is a number inside, which no user of the image is in."""
    rules = (DEPLOY / "udev" / "70-hairstage.rules").read_text()
    service = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]["service"]
    assert set(re.findall(r'GROUP="(\w+)"', rules)) == set(service["group_add"]) == {"dialout"}
    assert "--groups dialout" in (DEPLOY / "Containerfile").read_text()
    assert (
        "adduser hairstage dialout" in (DEPLOY.parent / "docs" / "how-to" / "deploy.md").read_text()
    )


def test_rig_files_use_the_ports_that_the_udev_rules_name():
    rules = (DEPLOY / "udev" / "70-hairstage.rules").read_text()
    devices = load_rig_file(rig_path("stage331")).devices
    assert devices is not None
    assert devices.projectors is not None
    for port in (devices.trigger.port, devices.projectors.port):
        assert f'SYMLINK+="{Path(port).name}"' in rules
