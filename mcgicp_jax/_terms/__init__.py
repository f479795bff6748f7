"""Residuals of correspondences, one term each."""
