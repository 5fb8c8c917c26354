"""A capacitive rotary encoder: its signals simulated, tracked and calibrated; and a recorded sine/cosine pair."""
