"""Estimators that follow moving targets causally."""
