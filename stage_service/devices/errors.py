"""What goes wrong on a wire, told so that somebody can act on it."""

from __future__ import annotations


class DeviceError(RuntimeError):
    """A device did not do what it was asked to.

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
    """Nothing, or not enough, came before the deadline."""


class DeviceUnreachable(DeviceError):
    """There is no connection to the device."""


class SafetyRefusal(DeviceError):
    """What an interlock, the emergency stop or a limit of `[safety]` forbids.

    Interlock and emergency stop are cleared by people at the stage, never from here.
    """


class IndexShift(DeviceError):
    """Pulses and frames do not match: frames could stand for the wrong step."""


class Cancelled(Exception):
    """A wait was given up because the capture is being stopped at once."""
