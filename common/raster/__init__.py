"""Differentiable rasterizer of 3D Gaussians for CPUs: Numba kernels with explicit SIMD vectors, no torch."""
