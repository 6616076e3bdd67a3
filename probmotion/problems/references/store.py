"""Lookup of stored reference draws, user-computed or shipped."""

from __future__ import annotations

from pathlib import Path

from probmotion.posteriors.reference import StoredReference

__all__ = ["find_reference", "references_folder"]

_SHIPPED = Path(__file__).parent


def references_folder() -> Path:
    """Return the folder of user-computed references in the data folder."""
    from probmotion.data.downloads import data_folder

    return data_folder() / "references"


def find_reference(name: str) -> StoredReference | None:
    """Return a problem's user-computed reference, else the shipped one, else None."""
    for folder in (references_folder(), _SHIPPED):
        if (folder / name / "certificate.json").is_file():
            return StoredReference.load(folder / name)
    return None
