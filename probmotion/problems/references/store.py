"""Lookup of stored references: the user's and the shipped ones."""

from __future__ import annotations

from pathlib import Path

from probmotion.posteriors.reference import StoredReference

__all__ = ["find_reference", "references_folder"]

_SHIPPED = Path(__file__).parent


def references_folder() -> Path:
    """Return the user's folder of references, beside the downloads."""
    from probmotion.data.downloads import data_folder

    return data_folder() / "references"


def find_reference(name: str) -> StoredReference | None:
    """Return the stored reference of a problem, preferring the user's, or None."""
    for place in (references_folder(), _SHIPPED):
        if (place / name / "certificate.json").is_file():
            return StoredReference.load(place / name)
    return None
