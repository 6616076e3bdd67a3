"""Atomic file writes, locks, checksums and formats, and safe reading of archives and JSON."""

from __future__ import annotations

import io
import json
import os
import platform
import re
import shutil
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

__all__ = [
    "LOCK",
    "UNSEALED",
    "check_format",
    "check_writable",
    "forget_killed",
    "locked_folder",
    "member_array",
    "open_archive",
    "read_arrays",
    "read_json",
    "sealed",
    "writable_folder",
    "write_errors",
    "write_json",
    "write_seal",
    "written_together",
    "written_whole",
]

LOCK = ".lock"
"""File of :func:`locked_folder`."""

UNSEALED = "crc32 --------"
"""Text that :func:`write_seal` replaces by a checksum of the same length."""

_CHECKSUM, _CHUNK = "crc32", 2**20

# An archive may unpack to this number of bytes, or to this multiple of its own size. Recorded
# numbers compress to a tenth at most, zeros to a thousandth.
_UNPACKED_BYTES, _UNPACKED_RATIO = 2**26, 100
_MANY_MEMBERS = 0xFFFF  # the number is elsewhere


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
        with write_errors(path):
            yield unfinished
            os.replace(unfinished, path)
    finally:
        # If the folder is missing, unlink fails too and must not mask the original error.
        with suppress(OSError):
            unfinished.unlink()


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Raise errors of the operating system in the block as ``OSError`` that names ``path``."""
    try:
        yield
    except OSError as error:
        # The error may be one of a file in the folder ``path``.
        reason = getattr(error.__cause__, "strerror", None) or error.strerror or str(error)
        raise OSError(f"cannot write {path}: {reason}; choose a writable folder") from error


def forget_killed(folder: Path) -> None:
    """Remove temporary files and folders in ``folder`` of killed processes of this machine.

    Files of other machines that share the folder are preserved: their processes may still run.
    """
    # Only POSIX can test for a process without affecting it.
    if os.name != "posix" or not folder.is_dir():
        return
    for path in folder.iterdir():
        match = _UNFINISHED.fullmatch(path.name)
        if match and not _is_running(int(match[1])):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
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


def writable_folder(folder: Path, name: str = "out") -> Path:
    """Return ``folder``, created if needed; raise ``OSError`` if it is not writable.

    It is the argument ``name`` of a function.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"{name} must be a writable folder, got {str(folder)!r}: {reason}") from error
    return folder


@contextmanager
def written_together(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; move its files to ``folder`` once the block succeeds.

    If it fails, ``folder`` is as before, or does not exist if it did not.

    Raises
    ------
    OSError
        If ``folder``, the argument ``out`` of a command, is not writable.
    """
    missing = [path for path in (folder, *folder.parents) if not os.path.exists(path)]
    suffix = f".{_MACHINE}.{os.getpid()}.unfinished"
    try:
        writable_folder(folder)
        forget_killed(folder)
        with (
            tempfile.TemporaryDirectory(prefix=".", suffix=suffix, dir=folder) as unfinished,
            write_errors(folder),
        ):
            yield Path(unfinished)
            for path in sorted(Path(unfinished).iterdir()):
                os.replace(path, folder / path.name)
    finally:
        for path in missing:
            with suppress(OSError):  # it has files
                path.rmdir()


def check_writable(folder: Path) -> None:
    """Raise ``OSError`` if the folder ``out`` is not writable; delete what this creates."""
    with written_together(folder):
        pass


@contextmanager
def locked_folder(name: str, folder: Path) -> Iterator[None]:
    """Lock a folder while the block runs; the argument ``name`` of a function is the folder.

    The operating system releases the lock when the process ends, even if it is killed.

    Raises
    ------
    ValueError
        If another process has locked it.
    """
    from filelock import FileLock, Timeout

    with ExitStack() as stack:
        try:
            stack.enter_context(FileLock(folder / LOCK, blocking=False, fallback_to_soft=False))
        except Timeout as error:
            raise ValueError(
                f"{name} must not be in use, got {str(folder)!r}, to which another process writes; "
                "wait for it to end or use another folder"
            ) from error
        yield


def open_archive(content: bytes) -> zipfile.ZipFile:
    """Return an ``.npz`` archive that unpacks to a plausible size.

    Raises
    ------
    ValueError
        If the content is no zip archive, lacks members, or unpacks to more than 64 MiB and 100
        times its size.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        for member in archive.infolist():
            with archive.open(member):  # compares the two names of a member
                pass
    except Exception as error:  # damaged zip files raise many types, including MemoryError
        raise ValueError(f"expected an npz archive ({str(error)[:80]})") from error
    # zipfile does not compare the number of members with that at the end of the archive.
    end, count = content.rfind(b"PK\5\6"), len(archive.infolist())
    members = int.from_bytes(content[end + 10 : end + 12], "little")
    if members not in (count, _MANY_MEMBERS):
        raise ValueError(f"expected an npz archive of {members} members, got {count}")
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


def check_format(content: MutableMapping[str, Any]) -> None:
    """Remove the entry ``format`` of a stored file; raise ``ValueError`` unless it is 1.

    Files without the entry have format 1.
    """
    import numpy as np

    got = np.asarray(content.pop("format", 1)).tolist()
    if got != 1:
        raise ValueError(
            f"format must be 1, got {got!r:.20}; use the version of probmotion that wrote the file"
        )


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON atomically, with a checksum in the entry ``crc32``."""
    stored = json.loads(json.dumps(content))  # keys are strings, as when it is read
    text = json.dumps({**stored, _CHECKSUM: _checksum(stored)}, indent=1)
    with written_whole(path) as unfinished:
        unfinished.write_text(text + "\n", encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file, without the checksum of :func:`write_json`.

    Raises
    ------
    ValueError
        If the file is not JSON in UTF-8, or its checksum does not match.
    OSError
        If the file cannot be opened.
    """
    try:
        content = json.loads(Path(path).read_bytes())
    except RecursionError as error:
        raise ValueError("expected JSON that is not nested deeply") from error
    if isinstance(content, dict) and _CHECKSUM in content:
        stored = content.pop(_CHECKSUM)
        if stored != _checksum(content):
            raise ValueError(f"expected the checksum {stored!r:.20}, got {_checksum(content)}")
    return content


def _checksum(content: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(content, sort_keys=True).encode()):08x}"


def sealed(path: Path, seal: str) -> str:
    """Return the checksum of a file that contains ``seal`` in its first mebibyte.

    The checksum is that of the file with :data:`UNSEALED` in this place, so that a file can contain
    its own.
    """
    with open(path, "rb") as file:
        value = zlib.crc32(file.read(_CHUNK).replace(seal.encode(), UNSEALED.encode(), 1))
        while chunk := file.read(_CHUNK):
            value = zlib.crc32(chunk, value)
    return f"crc32 {value:08x}"


def write_seal(path: Path) -> None:
    """Replace :data:`UNSEALED` in a file by the checksum."""
    seal = sealed(path, UNSEALED)
    with open(path, "r+b") as file:
        place = file.read(_CHUNK).index(UNSEALED.encode())
        file.seek(place)
        file.write(seal.encode())
