"""Glider flights through gaps by turn models and IMM."""
