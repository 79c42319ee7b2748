"""Interactive setup of a robot in a terminal: find sensors, calibrate, write deployment and rig file."""
