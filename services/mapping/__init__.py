"""The mapper: 3D Gaussians from keyframes with depth, optimised by differentiable rendering."""
