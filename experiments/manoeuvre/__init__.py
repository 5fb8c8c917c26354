"""A target that begins to accelerate: detecting it, and what to do then."""
