"""BeamSplat: a metric 3D Gaussian map from one camera and one 2D lidar."""

import beamsplat.common  # noqa: F401  one BLAS thread, before numpy is imported
