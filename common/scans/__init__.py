"""Reading of planar lidar scans as drivers publish them: repair, assembly, order and time of the beams.

`reader.ScanReader` is the one reader of bags, ROS 2 robots and our own drivers. It learns the rules of a
stream (`rules.ScanRules`) from its first messages and from the robot's motion, and applies them to each
message.
"""
