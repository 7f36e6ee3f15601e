"""Cameras, lights, projectors, rigs, meshes and strands: the shapes that the house shares."""
