"""Leases, the lock of a root folder, the latch and the audit log, each by itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from stage_service.acquisition.safety import Blackout
from stage_service.captures.latch import CannotAcknowledge, Latch, Unsafe
from stage_service.records.audit import AuditLog, NotRecorded
from stage_service.records.lease import Leased, Leases, NoLease, RootInUse, RootLock

DARK = Blackout(True, "dark")
LIT = Blackout(False, "unknown, unsafe: lamps: still lit")
UNREAD = Blackout(False, "unknown, unsafe: cannot be read back", accepted=True)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_lease_ends_by_itself_and_is_renewed_from_now(tmp_path):
    clock = Clock()
    leases = Leases(tmp_path / "lease.json", clock)
    first = leases.take("Ada", 10)
    with pytest.raises(Leased, match="Ada steers the stage until"):
        leases.take("Eve", 10)
    clock.now = 9.0
    assert leases.renew(first.token, 10).holder == "Ada"
    clock.now = 18.0
    leases.check(first.token)
    for stranger in (None, "", "é", first.token[:-1]):
        with pytest.raises(Leased):
            leases.check(stranger)
    clock.now = 19.0
    leases.check(None)
    assert leases.current is None
    with pytest.raises(NoLease):
        leases.renew(first.token, 10)
    second = leases.take("Eve", 10)
    assert second.token != first.token
    with pytest.raises(NoLease):
        leases.release(first.token)
    assert leases.holder(second.token) == "Eve"
    leases.release(second.token)
    leases.check(None)


def test_a_lease_is_on_the_disk_before_it_counts_and_counts_after_a_restart(tmp_path):
    path, clock, wall = tmp_path / "lease.json", Clock(), Clock()
    wall.now = 1e9
    token = Leases(path, clock, wall).take("Ada", 3600).token
    clock.now, wall.now = 0.0, wall.now + 1800  # another boot, half an hour later
    again = Leases(path, clock, wall)
    again.check(token)
    with pytest.raises(Leased, match="Ada"):
        again.check(None)
    clock.now = 1799.0
    assert again.current is not None
    clock.now = 1800.0
    assert again.current is None
    assert token not in path.read_text()


def test_a_clock_that_was_set_back_lengthens_no_lease(tmp_path):
    path, clock, wall = tmp_path / "lease.json", Clock(), Clock()
    wall.now = 1e9
    Leases(path, clock, wall).take("Ada", 60)
    wall.now -= 1e8
    again = Leases(path, clock, wall)
    assert again.current is not None
    clock.now = 60.0
    assert again.current is None


def test_a_lease_that_cannot_be_written_is_not_granted(tmp_path):
    leases = Leases(tmp_path / "missing" / "lease.json")
    with pytest.raises(NotRecorded, match="the lease could not be written"):
        leases.take("Ada", 60)
    assert leases.current is None


@pytest.mark.parametrize(
    "left",
    ["", "{", '{"holder": "Ada"}', '{"holder": "A", "digest": "-", "seconds": NaN, "ends": 1}'],
)
def test_a_damaged_lease_is_anybodys_for_a_day_and_an_admin_ends_it(tmp_path, left):
    path, clock, wall = tmp_path / "lease.json", Clock(), Clock()
    wall.now = 1e9
    path.write_text(left)
    leases = Leases(path, clock, wall)
    with pytest.raises(Leased, match="somebody unknown"):
        leases.check("any token")
    wall.now += 43200  # a restart begins no new day
    clock.now += 43200
    again = Leases(path, clock, wall)
    clock.now += 43200
    assert again.current is None
    Leases(path, clock, wall).end()
    assert Leases(path, clock, wall).current is None


def test_two_services_never_share_a_root(tmp_path):
    code = (
        "import sys; from pathlib import Path; from stage_service.records.lease import RootLock;"
        "lock = RootLock(Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdin is not None
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    with pytest.raises(RootInUse, match=f"process id {other.pid}: two services must not"):
        RootLock(tmp_path)
    other.kill()
    other.wait()
    other.stdin.close()
    other.stdout.close()
    lock = RootLock(tmp_path)
    lock.release()
    RootLock(tmp_path).release()


def test_the_latch_holds_until_a_blackout_is_read_back_dark(tmp_path):
    latch = Latch(tmp_path / "unsafe.json")
    latch.check()
    assert latch.learn(DARK, reads_back=True) is None
    assert latch.learn(LIT, reads_back=True) == "set"
    assert latch.learn(LIT, reads_back=True) is None
    again = Latch(tmp_path / "unsafe.json")
    with pytest.raises(Unsafe, match=r"still lit.*until a blackout reads every lamp back dark"):
        again.check()
    with pytest.raises(CannotAcknowledge):
        again.acknowledge()
    assert again.learn(DARK, reads_back=True) == "cleared"
    Latch(tmp_path / "unsafe.json").check()


def test_where_the_link_cannot_read_back_a_person_clears_the_latch(tmp_path):
    latch = Latch(tmp_path / "unsafe.json")
    assert latch.learn(UNREAD, reads_back=False) is None, "accepted: blocks nothing"
    latch.check()
    assert latch.learn(LIT, reads_back=False) == "set"
    assert latch.learn(UNREAD, reads_back=False) is None
    with pytest.raises(Unsafe, match="until somebody has looked"):
        latch.check()
    latch.acknowledge()
    latch.check()
    Latch(tmp_path / "unsafe.json").check()
    with pytest.raises(CannotAcknowledge, match="nothing is latched"):
        latch.acknowledge()


@pytest.mark.parametrize("text", ["", "{", "{}", "[]", '{"since": 1}', "\0"])
def test_a_damaged_latch_is_a_set_one(tmp_path, text):
    (tmp_path / "unsafe.json").write_text(text)
    latch = Latch(tmp_path / "unsafe.json")
    with pytest.raises(Unsafe, match="could not be read"):
        latch.check()
    with pytest.raises(CannotAcknowledge, match="send a blackout"):
        latch.acknowledge()
    assert latch.learn(LIT, reads_back=True) is None
    with pytest.raises(CannotAcknowledge, match="send a blackout"):
        latch.acknowledge()
    assert latch.learn(DARK, reads_back=True) == "cleared"
    Latch(tmp_path / "unsafe.json").check()


OTHER_BANK = '{"since": "2026-01-01T00:00:00+00:00", "detail": "still lit", "reads_back": true}'


@pytest.mark.parametrize("text", ["{", OTHER_BANK], ids=["damaged", "of another bank"])
def test_the_bank_says_who_can_end_a_latch_not_the_file(tmp_path, text):
    """Behind a bank that cannot read back no blackout ever comes to dark: a person ends it."""
    (tmp_path / "unsafe.json").write_text(text)
    latch = Latch(tmp_path / "unsafe.json")
    assert latch.learn(UNREAD, reads_back=False) is None, "as the service starts"
    for again in (latch, Latch(tmp_path / "unsafe.json")):
        with pytest.raises(Unsafe, match="until somebody has looked"):
            again.check()
    latch.acknowledge()
    Latch(tmp_path / "unsafe.json").check()


def test_a_torn_line_spoils_no_other(tmp_path):
    path = tmp_path / "audit.jsonl"
    log = AuditLog(path)
    assert log.latest(5) == []
    log.record("Ada", "blackout", "stage", "dark")
    with path.open("a") as file:
        file.write('{"time": "2026')
    log.record("Ada", "capture.start", "c1")
    log.record("Eve", "capture.start", "c2", "refused", "why")
    assert [(a.action, a.subject) for a in log.latest(10)] == [
        ("blackout", "stage"),
        ("capture.start", "c1"),
        ("capture.start", "c2"),
    ]
    (last,) = log.latest(1)
    assert (last.who, last.result, last.detail) == ("Eve", "refused", "why")


def test_a_disk_that_is_full_keeps_nobody_from_acting(caplog):
    log = AuditLog(Path("/dev/full"))
    log.record("Ada", "blackout", "stage", "dark")
    assert "not recorded" in caplog.text
