"""A balloon by the fuzzy mixed Kalman/H-infinity filter: what its adaptation does, and what would help."""
