"""Measurements that arrive late or never: a line-of-sight loop, and position messages over a 5G network."""
