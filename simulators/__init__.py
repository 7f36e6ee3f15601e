"""The device side of the wires: a rig without hardware, its frames rendered."""
