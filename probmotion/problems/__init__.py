"""Posteriors with known truth."""
