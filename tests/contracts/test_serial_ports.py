"""A serial port that one process has, and who gets it next."""

from __future__ import annotations

import os
import threading

import pytest
import serial

from stage_service.devices.serial_ports import ExclusivePort

PATIENT_S = 30.0


@pytest.fixture
def path():
    near, far = os.openpty()
    yield os.ttyname(far)
    os.close(near)
    os.close(far)


def test_a_port_is_free_at_its_close_though_a_child_that_was_forked_shares_it(path):
    first = ExclusivePort(path, timeout_s=0.0)
    childs = os.dup(first.fileno())  # the same open file, as fork(2) leaves it
    first.close()
    ExclusivePort(path, timeout_s=0.0).close()
    os.close(childs)


def test_a_port_that_is_let_go_of_in_time_is_opened(path):
    other = ExclusivePort(path, timeout_s=0.0)
    letting_go = threading.Timer(0.1, other.close)
    letting_go.start()
    with ExclusivePort(path, timeout_s=PATIENT_S) as port:
        assert port.is_open
        assert not other.is_open
    letting_go.join()


def test_a_port_that_another_keeps_is_refused(path):
    with (
        ExclusivePort(path, timeout_s=0.0),
        pytest.raises(serial.SerialException, match=f"exclusively lock port {path}"),
    ):
        ExclusivePort(path, timeout_s=0.05)
