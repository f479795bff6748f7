"""What users call for pairs of clouds."""
