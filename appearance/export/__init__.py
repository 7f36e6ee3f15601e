"""Fitted models for other programs: USD, Alembic, Blender, Unreal, Houdini, Mitsuba, glTF."""
