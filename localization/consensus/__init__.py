"""Localization by exchange among neighbours: consensus on relative vectors, and gradient-based team localization."""
