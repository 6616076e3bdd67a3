"""Tutorial pages of the documentation, copied from the executed notebooks."""

from __future__ import annotations

import shutil
from pathlib import Path


def write(docs: Path) -> None:
    """Copy ``notebooks/[0-9]*.ipynb``; raise FileNotFoundError if one is missing."""
    (docs / "tutorials").mkdir(exist_ok=True)
    notebooks = docs.parent / "notebooks"
    for script in sorted(notebooks.glob("[0-9]*.py")):
        executed = script.with_suffix(".ipynb")
        if not executed.exists():
            raise FileNotFoundError(f"{executed} must exist; run `make notebooks`")
        shutil.copyfile(executed, docs / "tutorials" / executed.name)
