"""Library code that all services share: messages, topics, bus, runners, geometry, recordings, rasterizer.

BLAS is limited to one thread in every process: the linear systems are small, all services share the cores,
and results must be identical bit by bit on any machine. BLAS reads these variables when numpy is first
imported, therefore they are set here.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
