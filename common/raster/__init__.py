"""Differentiable rasterization of 3D Gaussians on CPUs: Numba kernels on explicit SIMD vectors, no torch."""
