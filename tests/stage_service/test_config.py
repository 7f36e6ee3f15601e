"""Rig files, read strictly."""

from __future__ import annotations

from pathlib import Path

import pytest

from reconstruction.geometry.rig import RigError
from stage_service.captures.manager import CaptureManager
from stage_service.cli import main
from stage_service.config import load_rig_file
from stage_service.devices.device_set import DeviceSet
from stage_service.records.lease import RootLock

RIGS = Path(__file__).resolve().parents[2] / "stage_service" / "rigs"
SMALL = """
name = "small"
[[cameras]]
name = "cam_00"
position = [0.0, -0.95, 0.12]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 16
height = 12
[devices]
heartbeat_s = 0.5
watchdog_s = 2.0
[devices.lights]
port = 15020
[devices.trigger]
port = "trigger"
[devices.cameras]
port = 15021
busy_s = 900.0
[capture]
retries = 2
[capture.exposure]
olat = 0.02
"""


@pytest.mark.parametrize("path", sorted(RIGS.glob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_rig_loads(path):
    rig_file = load_rig_file(path)
    assert rig_file.devices is not None
    assert len(rig_file.rig.lights) == 331
    beside = [light.beside for light in rig_file.rig.lights if light.beside is not None]
    assert sorted(beside) == sorted(c.name for c in rig_file.rig.cameras)


def test_a_light_bank_without_lamps_is_refused_before_it_is_queried(tmp_path):
    (path := tmp_path / "rig.toml").write_text(SMALL)
    with pytest.raises(RigError, match=r"rig.toml: no lights"):
        DeviceSet.of(load_rig_file(path))


def test_devices_that_cannot_be_are_refused_once_and_leave_the_root_to_others(tmp_path, capsys):
    """By `rig check`, and as a service starts: before it has the stage, which it gave up with a
    traceback."""
    bad = tmp_path / "bad.toml"
    text = (RIGS / "demo.toml").read_text()
    assert text.count('kind = "modbus_tcp"') == 1
    bad.write_text(
        text.replace('kind = "modbus_tcp"', 'kind = "modbus_tcp"\nregisters = {levels = 900}')
    )
    assert main(["rig", "check", str(bad)]) == 3
    message = f"{bad}: devices.lights.registers: selector overlaps levels at 1000"
    assert message in capsys.readouterr().err
    with pytest.raises(RigError, match="selector overlaps levels"):
        CaptureManager(load_rig_file(bad), tmp_path / "root")
    RootLock(tmp_path / "root").release()


def changed(tmp_path: Path, old: str, new: str) -> Path:
    assert old in SMALL
    path = tmp_path / "rig.toml"
    path.write_text(SMALL.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("busy_s = 900.0", "buzy_s = 900.0", "devices.cameras.buzy_s"),
        ("port = 15020", "port = 150200", "devices.lights.port"),
        ("[devices.trigger]", "[devices.triger]", "devices.triger"),
        ("watchdog_s = 2.0", "watchdog_s = 0.6", "at most half of watchdog_s"),
        ("olat = 0.02", "olat = 0.0", "capture.exposure.olat"),
        ("[capture]", "[captures]", "captures"),
        ("[devices.trigger]", "[devices.trigger]\nbaud = 3000000000", "devices.trigger.baud"),
    ],
)
def test_errors_name_file_and_field(tmp_path, old, new, names):
    path = changed(tmp_path, old, new)
    with pytest.raises(RigError) as error:
        load_rig_file(path)
    assert str(path) in str(error.value)
    assert names in str(error.value)


def test_a_devices_file_wins_field_by_field(tmp_path):
    devices = tmp_path / "devices.toml"
    devices.write_text('[devices.lights]\nport = 4321\n[devices.trigger]\nport = "/dev/pts/9"\n')
    rig = tmp_path / "rig.toml"
    rig.write_text(SMALL)
    rig_file = load_rig_file(rig, devices)
    assert rig_file.devices is not None
    assert rig_file.devices.lights.port == 4321
    assert rig_file.devices.trigger.port == "/dev/pts/9"
    assert rig_file.devices.cameras.busy_s == 900.0


def test_a_devices_file_holds_devices_alone(tmp_path):
    devices = tmp_path / "devices.toml"
    devices.write_text("[capture]\nretries = 1\n")
    with pytest.raises(RigError, match=r"expected one table \[devices\]"):
        load_rig_file(RIGS / "demo.toml", devices)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RigError, match="no such rig file"):
        load_rig_file(tmp_path / "none.toml")


BEAM = """
[[projectors]]
name = "beam"
position = [0.1, -0.9, 0.5]
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = 16
height = 16
intensity = [20.0, 20.0, 20.0]
[[projectors]]
name = {name}
position = [-0.1, -0.9, 0.5]
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = 16
height = 16
intensity = [20.0, 20.0, 20.0]
[devices.projectors]
port = "projectors"
"""


def with_projector(name: str) -> str:
    beams, wire = BEAM.replace("{name}", name).split("[devices.projectors]")
    geometry, devices = SMALL.split("[devices]")
    return f"{geometry}{beams}[devices]{devices}[devices.projectors]{wire}"


@pytest.mark.parametrize(
    "name", ["left eye", "links_ö", 'a"b', "a,b", "a'b", "x" * 33, "<svg onload=x>"]
)
def test_projector_names_that_the_wire_cannot_carry_are_refused_as_they_are_read(tmp_path, name):
    """F19: on the controller's lines blanks part words and commas names."""
    (path := tmp_path / "rig.toml").write_text(with_projector(f"{name!r}"))
    place = r"rig.toml: \[\[projectors\]\] number 2: name: the projector controller takes 1 to 32 "
    with pytest.raises(RigError, match=place + "characters of the letters A to Z and a to z, digi"):
        load_rig_file(path)


def test_projector_names_that_the_wire_carries_are_taken(tmp_path):
    (path := tmp_path / "rig.toml").write_text(with_projector(f"'{'Left.eye-2_' * 3}'"[:33] + "'"))
    assert len(load_rig_file(path).rig.projectors[1].name) == 32


def test_a_rig_without_a_projector_controller_may_call_its_projectors_as_it_likes(tmp_path):
    text = with_projector("'left eye'").replace('[devices.projectors]\nport = "projectors"\n', "")
    (path := tmp_path / "rig.toml").write_text(text)
    assert load_rig_file(path).rig.projectors[1].name == "left eye"


@pytest.mark.parametrize(
    ("serials", "message"),
    [
        ('other = "1"', "serials: the serial number of the camera 'cam_00' is missing"),
        ('cam_00 = "1"\nother = "2"', "serials.other: the rig has no camera 'other'"),
        ('cam_00 = "0815 0000"', r"serials.cam_00: expected the letters.* got '0815 0000'"),
    ],
)
@pytest.mark.parametrize("kind", ["basler", "gphoto2"])
def test_serial_numbers_are_those_of_the_rig_s_cameras(tmp_path, serials, message, kind):
    cameras = f'[devices.cameras]\nkind = "{kind}"\ngain = 1.0\n[devices.cameras.serials]\n'
    text = SMALL.replace(
        "[devices.cameras]\nport = 15021\nbusy_s = 900.0\n", cameras + serials + "\n"
    )
    (path := tmp_path / "rig.toml").write_text(text)
    with pytest.raises(RigError, match=message):
        load_rig_file(path)


def test_cameras_that_the_service_releases_have_ports_and_no_hardware_stepping(tmp_path):
    cameras = '[devices.cameras]\nkind = "gphoto2"\ngain = 1.0\nrelease_s = 0.5\n'
    cameras += 'serials = { cam_00 = "usb:001,005" }\n'
    text = SMALL.replace("[devices.cameras]\nport = 15021\nbusy_s = 900.0\n", cameras)
    (path := tmp_path / "rig.toml").write_text(text)
    assert load_rig_file(path).devices.cameras.lag_s == 0.5
    path.write_text(text.replace("[devices]\n", "[devices]\nhardware_stepping = true\n"))
    with pytest.raises(RigError, match=r"cannot fire cameras of gphoto2.* set it to false"):
        load_rig_file(path)
