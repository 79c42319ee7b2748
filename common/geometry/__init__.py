"""Transforms, frames, cameras, calibration (rig), trajectories and lidar beams."""
