"""A simulated robot in a generated home: camera, 2D lidar and wheels, with exact truth of everything."""
