"""Recorded tracks as scenarios."""
