"""Every setting of the lidar SLAM in one frozen object; one configuration serves all lidars and logs.

What differs between sensors (angles, range limits, rate, beam count) comes with each scan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class LidarSlamSettings:
    """Physical assumptions and budgets; lengths in metres, angles in radians, times in seconds."""

    # Scan
    use_range_m: float = 30.0  # farther returns are too sparse to describe a surface
    min_spacing_m: float = 0.03  # returns closer together than this say the same thing to the matcher
    max_match_points: int = 360  # at most so many returns are matched
    min_points: int = 20  # a scan with fewer returns is rejected

    # Local map
    cell_m: float = 0.05
    reach_cells: int = 6  # a return finds its surface within this many cells
    range_sigma_m: float = 0.015  # noise of one return along the surface normal
    map_sigma_m: float = 0.02  # what repeated averaging does not remove (beam footprint, sensor bias)
    submap_nodes: int = 40  # each submap holds twice as many; neighbours share half
    min_submap_nodes: int = 10  # before a blind stretch may end a submap early
    motion_filter_distance_m: float = 0.15
    motion_filter_angle_rad: float = math.radians(8.0)
    motion_filter_time_s: float = 4.0

    # Matching
    outlier_m: float = 0.08  # a return this far from its surface has lost three quarters of its weight
    returns_per_measurement: float = 6.0  # neighbouring returns share their error: so many count as one
    search_min_m: float = 0.10
    search_max_m: float = 0.80
    search_min_rad: float = math.radians(4.0)
    search_max_rad: float = math.radians(35.0)
    good_inlier_ratio: float = 0.70  # share of returns on known surfaces below which a match is checked again
    lost_inlier_ratio: float = 0.50
    sure_inlier_ratio: float = 0.80  # a match far from its prediction must be at least this good

    # Motion
    max_speed_m_s: float = 3.0
    max_yaw_rate_rad_s: float = 6.0
    extrapolate_s: float = 0.5  # pose_at() follows the last velocity no longer than this

    # Pose graph
    edge_sigma_m: float = 0.01  # what a match cannot know about itself
    edge_sigma_rad: float = math.radians(0.15)
    # Drift from one submap to the next as seen on real logs: matches in a row share their errors.
    submap_drift_sigma_m: float = 0.03
    submap_drift_sigma_rad: float = math.radians(0.5)
    nodes_per_measurement: float = 4.0  # after refinement: so many poses in their own submap count as one
    job_nodes: int = 20  # background work is handed out every so many keynodes
    apply_after_scans: int = 20  # and its result is taken in exactly so many scans later
    max_loops_per_node: int = 3  # each keynode is tied to at most so many submaps of other passes
    loop_distance_m: float = 3.0  # a submap is "here" if one of its keynodes is this close
    local_window_m: float = 0.8  # loop windows up to this are searched for every keynode
    local_window_rad: float = math.radians(12.0)
    global_searches_per_job: int = 4  # larger windows: so many submaps per job
    max_global_window_m: float = 40.0
    merged_scans: int = 17  # keynodes merged for a wide search
    min_global_score: float = 0.30
    loop_min_inlier_ratio: float = 0.60
    loop_min_overlap: float = 0.40

    # Long operation
    min_covering_submaps: int = 6  # a submap that adds nothing to so many others of its place is taken out
    trim_every_jobs: int = 5
    lost_scans: int = 5  # so many scans without a match: start afresh and look for the place in the map
    link_every_scans: int = 10
    link_min_confidence: float = 0.5
    link_max_runner_up_ratio: float = (
        0.7  # one answer is enough if nowhere else comes near it; else two must agree
    )
    link_min_distance_m: float = 1.0  # from places at least this far apart
