"""Logs and their formats, pictures, bags and states: the only part that touches the contents of files."""
