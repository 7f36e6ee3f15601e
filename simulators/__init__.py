"""A simulated rig: the devices' side of the wires, with rendered frames."""
