"""Poses without an initial pose: features, matching, robust fit."""
