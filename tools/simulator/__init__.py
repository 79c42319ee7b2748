"""A simulated robot with camera, 2D lidar and wheel odometry in a generated home, with exact ground truth."""
