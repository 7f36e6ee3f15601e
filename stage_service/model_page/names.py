"""What results are called where people read them: in the terminal, the README's table, the page."""

from __future__ import annotations

THRESHOLDS = ("1mm_10deg", "2mm_20deg", "3mm_30deg")
GROUPS = ("held_out_lights", "held_out_camera")
STRANDS = {
    "ours": "ours",
    "hull_smooth_field": "hull + smooth field",
    "hull_vertical": "hull + vertical",
}
PICTURES = {
    "ours": "ours",
    "inverse_rendering": "inverse rendering",
    "sun_fit": "Sun's fit",
    "without_field": "without the field",
    "diffuse": "diffuse",
    "mean_colour": "mean colour",
    "three_nearest": "three nearest lights",
    "nearest_cameras": "three nearest cameras",
    "three_nearest_own_frames": "three nearest lights in that camera's own frames",
}


def threshold(name: str) -> str:
    """`1mm_10deg` as in print."""
    return name.replace("mm_", " mm/").replace("deg", "°")
