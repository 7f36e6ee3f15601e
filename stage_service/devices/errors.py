"""Errors of devices, with what to do next."""

from __future__ import annotations


class DeviceError(RuntimeError):
    """A device did not carry out a request.

    The message names the device, the operation, the deadline, what was expected and what was
    received, and what to do next; the same are attributes.
    """

    def __init__(
        self,
        device: str,
        operation: str,
        expected: str,
        received: str,
        todo: str,
        deadline_s: float | None = None,
    ) -> None:
        within = f" within {deadline_s:g} s" if deadline_s is not None else ""
        super().__init__(
            f"{device}: {operation}: expected {expected}{within}, received {received}. {todo}"
        )
        self.device, self.operation, self.deadline_s = device, operation, deadline_s
        self.expected, self.received, self.todo = expected, received, todo


class DeviceTimeout(DeviceError):
    """The device sent nothing, or not enough, before the deadline."""


class DeviceUnreachable(DeviceError):
    """There is no connection to the device."""


class SafetyRefusal(DeviceError):
    """An interlock, the emergency stop or a limit of `[safety]` forbids the request.

    People at the stage clear interlock and emergency stop; the service never does.
    """


class IndexShift(DeviceError):
    """Pulses and frames do not match: frames may be assigned to the wrong step."""


class Cancelled(Exception):
    """A wait ended early because the capture is being stopped."""
