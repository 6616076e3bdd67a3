"""The stored references of problems: the user's own, and those of the package."""

from __future__ import annotations

from pathlib import Path

from probmotion.posteriors.reference import StoredReference

__all__ = ["find_reference", "references_folder"]

_SHIPPED = Path(__file__).parent


def references_folder() -> Path:
    """Return where references are kept: ``references`` beside downloads, in the user's cache."""
    from probmotion.data.downloads import data_folder

    return data_folder() / "references"


def find_reference(name: str) -> StoredReference | None:
    """Return the reference kept of a problem: the user's own, else the package's, else None."""
    for place in (references_folder(), _SHIPPED):
        if (place / name / "certificate.json").is_file():
            return StoredReference.load(place / name)
    return None
