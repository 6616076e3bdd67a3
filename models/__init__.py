"""Priors: what one believes about motion."""
