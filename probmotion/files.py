"""Atomic file writes, checks of output folders, and safe reading of archives and JSON."""

from __future__ import annotations

import io
import json
import os
import platform
import re
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

__all__ = [
    "forget_killed",
    "member_array",
    "open_archive",
    "read_arrays",
    "read_json",
    "writable_folder",
    "written_whole",
]

# An archive may unpack to this number of bytes, or to this multiple of its own size. Recorded
# numbers compress to a tenth at most, zeros to a thousandth.
_UNPACKED_BYTES, _UNPACKED_RATIO = 2**26, 100


def _machine() -> str:
    """Return an identifier of this machine or container; host names alone are not unique."""
    parts = [platform.node()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
    with suppress(OSError):
        parts.append(os.readlink("/proc/self/ns/pid"))
    return f"{zlib.crc32(' '.join(parts).encode()):08x}"


_MACHINE = _machine()
_UNFINISHED = re.compile(rf"\..*\.{_MACHINE}\.(\d+)\.unfinished(\.[^.]*)?")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` once the block succeeds.

    Raises
    ------
    OSError
        If the folder does not exist or is not writable.
    """
    path = Path(path)
    # Writers choose the format by the suffix, so the temporary name has the same suffix.
    owner = f"{_MACHINE}.{os.getpid()}"
    unfinished = path.with_name(f".{path.stem}.{owner}.unfinished{path.suffix}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"cannot write {path}: {reason}; choose a writable folder") from error
    finally:
        # If the folder is missing, unlink fails too and must not mask the original error.
        with suppress(OSError):
            unfinished.unlink()


def forget_killed(folder: Path) -> None:
    """Remove temporary files in ``folder`` written by killed processes of this machine.

    Files of other machines that share the folder are preserved: their processes may still run.
    """
    # Only POSIX can test for a process without affecting it.
    if os.name != "posix" or not folder.is_dir():
        return
    for path in folder.iterdir():
        match = _UNFINISHED.fullmatch(path.name)
        if match and not _is_running(int(match[1])):
            with suppress(OSError):
                path.unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # a process of another user
        pass
    return True


def writable_folder(folder: Path) -> Path:
    """Return ``folder``, created if needed; raise ``OSError`` if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"out must be a writable folder, got {str(folder)!r}: {reason}") from error
    return folder


def open_archive(content: bytes) -> zipfile.ZipFile:
    """Return an ``.npz`` archive that unpacks to a plausible size.

    Raises
    ------
    ValueError
        If the content is no zip archive, or unpacks to more than 64 MiB and 100 times its size.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except Exception as error:  # damaged zip files raise many types, including MemoryError
        raise ValueError(f"expected an npz archive ({str(error)[:80]})") from error
    unpacked = sum(member.file_size for member in archive.infolist())
    most = max(_UNPACKED_BYTES, _UNPACKED_RATIO * len(content))
    if unpacked > most:
        raise ValueError(f"expected an npz archive of at most {most} bytes, got {unpacked}")
    return archive


def member_array(archive: zipfile.ZipFile, key: str) -> np.ndarray:
    """Return an array of an ``.npz`` archive; pickled objects are refused.

    Raises
    ------
    KeyError
        If there is no such array.
    ValueError
        If it is damaged or has objects.
    """
    import numpy as np

    name = f"{key}.npy"
    if name not in archive.namelist():
        raise KeyError(key)
    try:
        array = np.lib.format.read_array(io.BytesIO(archive.read(name)), allow_pickle=False)
    except Exception as error:  # as in open_archive; pickled objects raise ValueError
        raise ValueError(
            f"expected numbers or strings in {key[:40]} ({str(error)[:80]})"
        ) from error
    # Arrays without bytes may have any shape.
    if array.dtype.names is not None or not array.dtype.itemsize:
        raise ValueError(f"expected numbers or strings in {key[:40]}, got {array.dtype!s:.80}")
    if array.dtype.kind == "U" and not _is_text(array):
        raise ValueError(f"expected Unicode in {key[:40]}, got invalid characters")
    return array


def _is_text(array: np.ndarray) -> bool:
    """Return whether all characters exist; NumPy does not check them."""
    import numpy as np

    codes = np.frombuffer(array.tobytes(), np.dtype("u4").newbyteorder(array.dtype.byteorder))
    surrogate = (codes >= 0xD800) & (codes < 0xE000)
    return bool((codes <= sys.maxunicode).all() and not surrogate.any())


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """Return all arrays of an ``.npz`` archive by key; see :func:`open_archive`.

    Raises
    ------
    ValueError
        If the file is no such archive, or is damaged.
    OSError
        If the file cannot be opened.
    """
    with open_archive(Path(path).read_bytes()) as archive:
        names = [name for name in archive.namelist() if name.endswith(".npy")]
        return {key: member_array(archive, key) for key in (n.removesuffix(".npy") for n in names)}


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.

    Raises
    ------
    ValueError
        If the file is not JSON in UTF-8.
    OSError
        If the file cannot be opened.
    """
    try:
        return json.loads(Path(path).read_bytes())
    except RecursionError as error:
        raise ValueError("expected JSON that is not nested deeply") from error
