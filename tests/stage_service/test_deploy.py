"""What deploy/ offers to install must fit the command line and the rig files that come with it."""

from __future__ import annotations

import configparser
import shlex
from pathlib import Path

import pytest

from stage_service.cli import build_parser
from stage_service.cli.support.commands import rig_path
from stage_service.config import load_rig_file

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"


@pytest.mark.parametrize(
    "unit", sorted((DEPLOY / "systemd").glob("*.service")), ids=lambda p: p.name
)
def test_units_start_commands_that_there_are(unit):
    read = configparser.ConfigParser(strict=False, interpolation=None)
    read.optionxform = str
    read.read(unit)
    program, *arguments = shlex.split(read["Service"]["ExecStart"])
    assert Path(program).name == "hairstage"
    parsed = build_parser().parse_args(arguments)
    assert str(parsed.root) == "/var/lib/hairstage"


def test_rig_files_use_the_ports_that_the_udev_rules_name():
    rules = (DEPLOY / "udev" / "70-hairstage.rules").read_text()
    devices = load_rig_file(rig_path("stage331")).devices
    assert devices is not None
    assert devices.projectors is not None
    for port in (devices.trigger.port, devices.projectors.port):
        assert f'SYMLINK+="{Path(port).name}"' in rules
