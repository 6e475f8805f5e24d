"""Comparing estimators and solvers: plans, paired trials, a store that survives interruption, metrics and reports."""
