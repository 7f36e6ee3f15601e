from .motion import Motion as Motion
from .point_cloud import PointCloud as PointCloud
from .tracking import solve_motion as solve_motion
from .triangulation import sweep_peaks as sweep_peaks
from .triangulation import triangulate as triangulate
