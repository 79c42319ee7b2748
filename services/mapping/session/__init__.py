"""Maps that live on: folders that a mapper is saved to and resumes from, and what can be done with them.

session.json            one UUID and the format's version; written once
edge/edge.json          the edge half's manifest: which state is the valid one; replaced last, atomically
edge/state-N.npz        Gaussians with optimiser state, anchors, keyframes' poses and exposures
edge/keyframes/ID.kf    one self-sufficient keyframe each, as it came
robot/                  the robot half: lidar map, grid and trajectory, as localization saves them
"""
