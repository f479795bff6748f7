"""The surface around each point, for any method: neighbourhoods, covariances, channel fits, observability."""
