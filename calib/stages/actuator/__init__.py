"""The two-bellows actuator: kinematics, dynamics and pumps, in SI units and without files."""
