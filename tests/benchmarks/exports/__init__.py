"""Exports as another program finds them: Blender."""
