"""Sessions: folders that a mapper is saved to while it runs, and resumed from.

session.json            UUID and format version; written once
edge/edge.json          manifest of the edge half: names the valid state; replaced last, atomically
edge/state-N.npz        Gaussians with optimiser state, anchors, poses and exposures of keyframes
edge/gaussians/N.block  Gaussians that are paged out
edge/keyframes/ID.kf    one keyframe message each, as received
robot/                  the robot half: lidar map, grid and trajectory, as localization saves them
"""
