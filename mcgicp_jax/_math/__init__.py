"""Numbers only: symmetric matrices, poses, statistics, robust kernels."""
