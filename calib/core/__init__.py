"""What every part shares: verdicts, units, errors, geometry, and the shape of a result."""

__version__ = "0.1.0"
