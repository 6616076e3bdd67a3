"""Copy the executed notebooks to where Sphinx finds them."""

from __future__ import annotations

import shutil
from pathlib import Path


def write(docs: Path) -> None:
    """Copy ``notebooks/[0-9]*.ipynb`` and fail where a tutorial was not executed."""
    (docs / "tutorials").mkdir(exist_ok=True)
    notebooks = docs.parent / "notebooks"
    for script in sorted(notebooks.glob("[0-9]*.py")):
        executed = script.with_suffix(".ipynb")
        if not executed.exists():
            raise FileNotFoundError(f"{executed} is missing; run `make notebooks`")
        shutil.copyfile(executed, docs / "tutorials" / executed.name)
