"""Spherical harmonics of degree 1 to 3: colours of Gaussians that depend on the viewing direction."""
