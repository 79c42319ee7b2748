"""What all services share: messages, topics, the bus, runners, geometry, recordings, the rasterizer.

BLAS gets one thread in every process: its pools spin for the small systems solved here, the cores are shared
by all services, and the same bytes must come out on any machine. It reads the variables when numpy is first
imported, which is why they are set here.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
