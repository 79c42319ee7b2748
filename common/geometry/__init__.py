"""Rigid transforms, coordinate frames, camera models, calibration (rig), trajectories and lidar beams."""
