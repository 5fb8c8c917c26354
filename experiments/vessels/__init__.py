"""Vessels tracked by the positions in their AIS reports."""
