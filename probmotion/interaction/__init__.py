"""Interaction of characters: coordinates, views, annotations and the likelihood they make."""
