"""Geometry from planes of light (Photobooth §3.1): triangulation, conditioning and motion."""

from reconstruction.light_planes.motion import Motion
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.light_planes.tracking import solve_motion
from reconstruction.light_planes.triangulation import TriangulateOptions, sweep_peaks, triangulate

__all__ = [
    "Motion",
    "PointCloud",
    "TriangulateOptions",
    "solve_motion",
    "sweep_peaks",
    "triangulate",
]
