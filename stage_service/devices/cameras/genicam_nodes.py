"""A GenICam node map: settings by name, where the camera has them, with errors as sentences."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from stage_service.devices.errors import DeviceError

Value = bool | int | float | str
TODO = "Check [devices.cameras] against the camera model's documentation."


class Nodes(ABC):
    """A camera's node map; `failures` are the exceptions of a value that the camera refuses."""

    def __init__(self, device: str, failures: type[Exception]) -> None:
        self.device = device
        self._failures = failures

    @abstractmethod
    def has(self, name: str) -> bool:
        """Whether the camera has the node in its present state."""

    @abstractmethod
    def symbols(self, name: str) -> tuple[str, ...]:
        """The values that an enumeration offers now; none where the camera lacks it."""

    @abstractmethod
    def number(self, name: str) -> float | None:
        """A node's value, or None where the camera lacks it or it is not readable."""

    @abstractmethod
    def text(self, name: str) -> str | None:
        """As `number`, for nodes of any kind; "1" and "0" of a Boolean."""

    @abstractmethod
    def execute_if_there(self, name: str) -> None:
        """Execute a command, where the camera has it."""

    def write_if_there(self, name: str, value: Value) -> None:
        """As `write`, where the camera has the node."""
        if self.has(name):
            self.write(name, value)

    def write(self, name: str, value: Value) -> None:
        """Set a node. Raises `DeviceError` where the camera lacks it or refuses the value."""
        wanted = str(int(value)) if isinstance(value, bool) else str(value)
        held = self.text(name)
        if held == wanted:
            return  # fixed nodes, as the mode of an input-only line, are read-only
        if not self._is_writable(name):
            received = "no such node" if held is None else f"{held}, which it does not let change"
            raise self._error(name, value, f"{name} = {wanted}", received)
        try:
            self._set(name, wanted)
        except self._failures as error:
            raise self._error(name, value, self._range(name), wanted) from error

    @abstractmethod
    def _is_writable(self, name: str) -> bool: ...

    @abstractmethod
    def _set(self, name: str, wanted: str) -> None: ...

    @abstractmethod
    def _range(self, name: str) -> str:
        """The values that the node takes, for errors."""

    def _error(self, name: str, value: Value, expected: str, received: str) -> DeviceError:
        return DeviceError(self.device, f"setting {name} to {value}", expected, received, TODO)


class PylonNodes(Nodes):
    """The node map `nodes` of a camera; `genicam` is pylon's module of that name."""

    def __init__(self, device: str, nodes: Any, genicam: Any) -> None:
        super().__init__(device, genicam.GenericException)
        self._nodes = nodes
        self._genicam = genicam

    def has(self, name: str) -> bool:
        return bool(self._genicam.IsAvailable(self._nodes.GetNode(name)))

    def symbols(self, name: str) -> tuple[str, ...]:
        return tuple(self._nodes.GetNode(name).GetSettableValues()) if self.has(name) else ()

    def number(self, name: str) -> float | None:
        node = self._nodes.GetNode(name)
        return node.GetValue() if self._genicam.IsReadable(node) else None

    def text(self, name: str) -> str | None:
        node = self._nodes.GetNode(name)
        return node.ToString() if self._genicam.IsReadable(node) else None

    def execute_if_there(self, name: str) -> None:
        if self._is_writable(name):
            self._nodes.GetNode(name).Execute()

    def _is_writable(self, name: str) -> bool:
        return bool(self._genicam.IsWritable(self._nodes.GetNode(name)))

    def _set(self, name: str, wanted: str) -> None:
        self._nodes.GetNode(name).FromString(wanted)

    def _range(self, name: str) -> str:
        node = self._nodes.GetNode(name)
        if hasattr(node, "Symbolics"):
            return "one of " + ", ".join(node.GetSettableValues())
        if hasattr(node, "GetMin"):
            return f"{node.GetMin():g} to {node.GetMax():g}"
        return "a value that the camera accepts"
