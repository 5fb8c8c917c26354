"""A random sine, tracked by extended and unscented Kalman filters."""
