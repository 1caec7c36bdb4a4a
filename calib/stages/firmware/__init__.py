"""The constants of rig.yaml as C for a microcontroller."""
