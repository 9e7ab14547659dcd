"""Drawings: a rig, a frame, depth images, four views of a rig, error against run time."""
