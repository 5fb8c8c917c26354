"""The version, in the one place that both the build and ``import jaxfilt`` read."""

__version__ = "0.1.0"
