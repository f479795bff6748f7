"""Pose graphs: the graph, its optimisation, initial poses, marginal covariances."""
