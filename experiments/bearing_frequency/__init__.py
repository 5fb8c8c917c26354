"""Bearing-and-frequency tracking: adaptive EKFs against the Cramer-Rao bound, and where a track can start."""
