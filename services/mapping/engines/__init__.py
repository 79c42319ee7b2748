"""The engines of the mapper: they hold the Gaussians and do the work on every pixel and Gaussian."""
