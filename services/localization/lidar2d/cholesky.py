"""Solution of small symmetric systems inside other kernels."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel


@kernel
def solve(A: np.ndarray, b: np.ndarray, x: np.ndarray) -> bool:
    """Solve A x = b for symmetric A [N, N] by Cholesky; return False if A is not positive definite.

    The lower triangle of A is overwritten by its Cholesky factor.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i == j:
                if not total > 1e-12 * A[i, i]:
                    return False
                A[i, i] = math.sqrt(total)
            else:
                A[i, j] = total / A[j, j]
    for i in range(n):
        x[i] = b[i]
        for k in range(i):
            x[i] -= A[i, k] * x[k]
        x[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= A[k, i] * x[k]
        x[i] /= A[i, i]
    return True
