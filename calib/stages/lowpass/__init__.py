"""Filters of sampled signals."""
