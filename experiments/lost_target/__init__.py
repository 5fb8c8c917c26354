"""A target lost for a part of its path: strategies for missing measurements, tuned and compared."""
