"""What calibration raises."""

from __future__ import annotations


class CalibrationError(ValueError):
    """Captures that do not determine what is asked; says which, why, and what to shoot."""
