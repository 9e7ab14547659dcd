"""Scenarios of recorded tracks."""
