"""From sums over correspondences to a pose, its derivative and its covariance."""
