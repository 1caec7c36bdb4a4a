"""Numerical methods that know nothing of what they are used for."""
