"""A GenICam node map: settings by name, where the camera has them, with errors as sentences."""

from __future__ import annotations

from typing import Any

from stage_service.devices.errors import DeviceError

Value = bool | int | float | str
TODO = "Check [devices.cameras] against the camera model's documentation."


class Nodes:
    """The node map `nodes` of a camera; `genicam` is pypylon's module of that name."""

    def __init__(self, device: str, nodes: Any, genicam: Any) -> None:
        self.device = device
        self._nodes = nodes
        self._genicam = genicam

    def has(self, name: str) -> bool:
        """Whether the camera has the node in its present state."""
        return bool(self._genicam.IsAvailable(self._nodes.GetNode(name)))

    def symbols(self, name: str) -> tuple[str, ...]:
        """The values that an enumeration offers now; none where the camera lacks it."""
        return tuple(self._nodes.GetNode(name).GetSettableValues()) if self.has(name) else ()

    def number(self, name: str) -> float | None:
        """A node's value, or None where the camera lacks it or it is not readable."""
        node = self._nodes.GetNode(name)
        return node.GetValue() if self._genicam.IsReadable(node) else None

    def text(self, name: str) -> str | None:
        """As `number`, for nodes of any kind."""
        node = self._nodes.GetNode(name)
        return node.ToString() if self._genicam.IsReadable(node) else None

    def write_if_there(self, name: str, value: Value) -> None:
        """As `write`, where the camera has the node."""
        if self.has(name):
            self.write(name, value)

    def write(self, name: str, value: Value) -> None:
        """Set a node. Raises `DeviceError` where the camera lacks it or refuses the value."""
        node = self._nodes.GetNode(name)
        wanted = str(int(value)) if isinstance(value, bool) else str(value)
        if self.text(name) == wanted:
            return  # fixed nodes, as the mode of an input-only line, are read-only
        if not self._genicam.IsWritable(node):
            held = self.text(name)
            received = "no such node" if held is None else f"{held}, which it does not let change"
            raise self._error(name, value, f"{name} = {wanted}", received)
        try:
            node.FromString(wanted)
        except self._genicam.GenericException as error:
            raise self._error(name, value, self._range(node), wanted) from error

    def execute_if_there(self, name: str) -> None:
        """Execute a command, where the camera has it."""
        node = self._nodes.GetNode(name)
        if self._genicam.IsWritable(node):
            node.Execute()

    def _range(self, node: Any) -> str:
        if hasattr(node, "Symbolics"):
            return "one of " + ", ".join(node.GetSettableValues())
        if hasattr(node, "GetMin"):
            return f"{node.GetMin():g} to {node.GetMax():g}"
        return "a value that the camera accepts"

    def _error(self, name: str, value: Value, expected: str, received: str) -> DeviceError:
        return DeviceError(self.device, f"setting {name} to {value}", expected, received, TODO)
