"""Settings of the lidar SLAM in one frozen object; the defaults serve all lidars and logs.

Properties of the sensor (angles, range limits, rate, number of beams) are part of each scan. The values were
tuned with `beamsplat bench slam`, where no other source is given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class LidarSlamSettings:
    """Physical assumptions and limits; lengths in metres, angles in radians, times in seconds."""

    # Scan
    use_range_m: float = 30.0  # farther returns are dropped: too sparse to describe a surface
    min_spacing_m: float = 0.03  # voxel filter: minimum distance between matched returns
    max_match_points: int = 360  # limit of the adaptive voxel filter
    min_points: int = 20  # scans with fewer returns are rejected

    # Local map
    cell_m: float = 0.05  # cell size of the local map
    reach_cells: int = 6  # a return is associated with a surface within this many cells
    range_sigma_m: float = 0.015  # noise of one return along the surface normal
    map_sigma_m: float = 0.02  # error that averaging does not remove (beam footprint, sensor bias)
    submap_nodes: int = 40  # a new submap starts after this many nodes; each submap holds twice as many
    min_submap_nodes: int = 10  # minimum before a degenerate stretch ends a submap early
    motion_filter_distance_m: float = 0.15  # a scan becomes a node after this motion
    motion_filter_angle_rad: float = math.radians(8.0)  # a scan becomes a node after this rotation
    motion_filter_time_s: float = 4.0  # a scan becomes a node after this time

    # Matching
    outlier_m: float = 0.08  # Geman-McClure scale: the weight is 1/4 at this distance from the surface
    returns_per_measurement: float = 6.0  # neighbouring returns have correlated errors: so many count as one
    search_min_m: float = 0.10  # lower limit of the correlative search window
    search_max_m: float = 0.80  # upper limit of the correlative search window
    search_min_rad: float = math.radians(4.0)  # lower limit of the search window in rotation
    search_max_rad: float = math.radians(35.0)  # upper limit of the search window in rotation
    good_inlier_ratio: float = 0.70  # below it, the search is repeated in a larger window
    lost_inlier_ratio: float = 0.50  # below it, the match is rejected
    sure_inlier_ratio: float = 0.80  # minimum for a match far from its prediction

    # Motion
    max_speed_m_s: float = 3.0  # a match that implies faster motion is rejected
    max_yaw_rate_rad_s: float = 6.0  # a match that implies faster rotation is rejected
    prior_correlation_scans: float = 30.0  # errors of so many consecutive predictions have the same cause
    extrapolate_s: float = 0.5  # the last velocity is extrapolated for at most this time

    # Pose graph
    edge_sigma_m: float = 0.01  # error of a match that is not in its information matrix
    edge_sigma_rad: float = math.radians(0.15)  # error in rotation of a match, likewise not in that matrix
    # As measured on real logs; errors of consecutive matches correlate.
    submap_drift_sigma_m: float = 0.03  # drift between consecutive submaps
    submap_drift_sigma_rad: float = math.radians(0.5)  # drift in rotation between consecutive submaps
    nodes_per_measurement: float = 4.0  # after refinement, this many constraints within a submap count as one
    job_nodes: int = 20  # a background job starts after this many new nodes
    apply_after_scans: int = 20  # the result of a job is applied exactly this many scans later
    max_loops_per_node: int = 3  # maximum number of loop closures per node
    loop_every_nodes: int = 3  # loop closures are searched for every n-th node
    loop_distance_m: float = 3.0  # a submap is near if one of its nodes is within this distance
    local_window_m: float = 0.8  # largest window of the local loop search, done for every node
    local_window_rad: float = math.radians(12.0)  # largest rotation in the local loop search
    place_nodes: int = 40  # scans of a chunk that is searched in the whole map
    place_points: int = 400  # returns of a chunk
    max_place_targets: int = 100  # submaps that are searched for one chunk
    min_place_score: float = 0.5  # minimum mean likelihood of a chunk in the coarse search
    place_min_inlier_ratio: float = 0.75  # minimum of a chunk in a submap
    loop_min_inlier_ratio: float = 0.60  # a loop closure with less is rejected
    loop_min_overlap: float = 0.40  # a loop closure with less of its scan in mapped area is rejected

    # Lifelong operation
    min_covering_submaps: int = 6  # a submap is trimmed if this many others cover its nodes
    trim_every_jobs: int = 5  # jobs between two searches for submaps to trim
    lost_scans: int = 5  # scans in a row without a match, after which a new segment starts
    link_every_scans: int = 10  # interval between relocalization attempts of a segment
    link_max_runner_up_ratio: float = 0.7  # a match without a rival above it links segments alone
