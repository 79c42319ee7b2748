"""The mapper: Gaussians from keyframes with depth, optimised by differentiable rendering."""
