"""A study: each claim of the source document computed again, its figures drawn again, by calling `calib`."""
