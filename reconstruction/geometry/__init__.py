"""Cameras, lights, projectors, rigs, meshes and strands."""
