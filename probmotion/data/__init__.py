"""Motions made by the project, clips that a user points at, and public ones fetched by name."""
