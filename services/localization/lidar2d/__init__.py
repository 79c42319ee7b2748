"""2D lidar SLAM on numpy arrays: no bus, no messages, no configuration files, no wall clock."""
