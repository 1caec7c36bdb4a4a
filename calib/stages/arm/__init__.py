"""A bending arm under a pressure valve: its assembly of parts, from logs of pressure and motion capture."""
