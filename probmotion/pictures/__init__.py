"""Skeletons and plots."""
