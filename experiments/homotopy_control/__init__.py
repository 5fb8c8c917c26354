"""Predictive control by homotopy perturbation, with an extended Kalman filter in the loop."""
