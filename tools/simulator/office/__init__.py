"""A generated office floor for long drives of a robot with a 2D lidar: cheap, planar, with exact truth."""
