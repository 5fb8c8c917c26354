"""Joint tracking and classification: one particle filter over state, class and mode of motion."""
