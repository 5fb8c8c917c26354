"""A cut satellite position bridged by a car's other sensors."""
