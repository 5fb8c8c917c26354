"""Output feedback for uncertain positive systems by linear programming, and the interval observer."""
