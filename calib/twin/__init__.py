"""The simulated rig: it renders pictures and makes logs, and it alone knows the truth."""
