"""Scenes of hair for Mitsuba."""
