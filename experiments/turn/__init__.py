"""A target that turns, tracked by an interacting multiple model estimator."""
