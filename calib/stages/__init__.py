"""The stages of a calibration: each folder has its mathematics, its section of rig.yaml and its verb."""
