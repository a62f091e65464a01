"""Simulated buildings, obstacles and drives."""
