"""Names of problems and samplers, which are names of folders too."""

from __future__ import annotations

import re

__all__ = ["check_name"]

_NAME = re.compile(r"\w[\w.,=+() -]*")
# Maximum length of a folder name in bytes, without the affixes of temporary names.
_LONGEST = 200


def check_name(argument: str, name: str) -> None:
    """Raise ``ValueError`` unless a name is the name of one folder on all systems.

    ``argument`` is the argument or file entry with the name, in the error.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"names of {argument} must consist of letters, digits and . , = + ( ) - _, got {name!r}"
        )
    if (length := len(name.encode())) > _LONGEST:
        raise ValueError(
            f"names of {argument} must have at most {_LONGEST} bytes, got {length}: {name[:20]}…"
        )
