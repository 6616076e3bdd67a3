"""Motions made by the project, and clips that a user points at."""
