"""Geometry from planes of light (Photobooth §3.1): triangulation, conditioning and motion."""

from reconstruction.light_planes.motion import Motion as Motion
from reconstruction.light_planes.point_cloud import PointCloud as PointCloud
from reconstruction.light_planes.tracking import solve_motion as solve_motion
from reconstruction.light_planes.triangulation import sweep_peaks as sweep_peaks
from reconstruction.light_planes.triangulation import triangulate as triangulate
