"""Download of public motion data by name, with verification and a cache.

``registry.csv`` lists the repository, commit, path, SHA-256 and size of each file.
Terms of Carnegie Mellon University apply (:data:`CMU_TERMS`); cite :data:`CMU_ACKNOWLEDGEMENT`.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from probmotion.data.pairs import load_pairs, read_salsa_bvh
from probmotion.motion.motion import Motion

__all__ = [
    "CMU_ACKNOWLEDGEMENT",
    "CMU_TERMS",
    "SALSA_TRIALS",
    "DownloadError",
    "data_folder",
    "data_places",
    "download",
    "salsa_pairs",
]

CMU_ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created "
    "with funding from NSF EIA-0196217."
)
"""Acknowledgement that CMU requests in publications."""

CMU_TERMS = (
    "This data is free for use in research and commercial projects worldwide. If you publish "
    "results obtained using this data, we would appreciate it if you would send the citation to "
    "your published paper to jkh+mocap@cs.cmu.edu, and also would add this text to your "
    f'acknowledgments section: "{CMU_ACKNOWLEDGEMENT}"'
)
"""CMU's terms as stated by the database. The data themselves may not be sold."""

SALSA_TRIALS = ("01", "02", "03", "04", "05", "06", "07", "09", "10", "11")
"""Trials that :func:`salsa_pairs` loads. The registry also lists 12 to 15; 08 does not exist."""

_ADDRESS = "https://raw.githubusercontent.com"
_FOLDER_VARIABLE = "PROBMOTION_DATA"
_REGISTRY = Path(__file__).with_name("registry.csv")
_TIMEOUT = 30.0  # seconds without a response
_CHUNK = 2**16  # bytes


class DownloadError(OSError):
    """Error for a failed download, a wrong size or SHA-256; the message contains the file's URL."""


class _TooLarge(Exception):  # noqa: N818
    """Raised when a download exceeds its size."""


class _Entry(NamedTuple):  # row of registry.csv
    dataset: str
    repository: str
    commit: str
    path: str
    sha256: str
    bytes: str
    licence: str

    @property
    def name(self) -> str:
        return self.path.rpartition("/")[2]


def data_folder() -> Path:
    """Return the download folder: ``PROBMOTION_DATA`` if set, else a folder in the user's cache."""
    import pooch

    return Path(os.environ.get(_FOLDER_VARIABLE) or pooch.os_cache("probmotion"))


def data_places(folder: str | Path | None = None) -> list[Path]:
    """Return the folders to search for clips, in order.

    If ``folder`` is given, it is the only one. The defaults are the environment variable
    ``PROBMOTION_DATA`` if set, ``../shared/data`` and :func:`data_folder`.
    """
    if folder is not None:
        return [Path(folder)]
    named = os.environ.get(_FOLDER_VARIABLE)
    folders = [*([Path(named)] if named else []), Path("../shared/data"), data_folder()]
    return list(dict.fromkeys(folders))


def download(
    dataset: str = "cmu-salsa",
    names: Sequence[str] | None = None,
    folder: str | Path | None = None,
    base_url: str | None = None,
    progress: bool = False,
) -> list[Path]:
    """Download files of a data set, verify their SHA-256 and return their paths.

    Existing intact files are not downloaded again. Incomplete downloads are discarded. CMU's
    terms apply (:data:`CMU_TERMS`).

    Parameters
    ----------
    dataset : str
        ``"cmu-salsa"`` (BVH, subjects 60 and 61) or ``"cmu-01-02-03"`` (ASF and AMC).
    names : sequence of str, optional
        File names, such as ``"60_10_scaled.bvh"``; all files by default (71 MB or 62 MB).
    folder : str or Path, optional
        Parent of the data set's folder; :func:`data_folder` by default.
    base_url : str, optional
        URL of a mirror, to which ``/repository/commit/path`` is appended; GitHub by default.
    progress : bool
        Whether to show a progress bar for each file.

    Raises
    ------
    ValueError
        If the data set or a name is unknown.
    DownloadError
        If a file cannot be downloaded or written, is too large, or its SHA-256 is wrong.
    """
    entries = _chosen(dataset, names)
    target = (data_folder() if folder is None else Path(folder)) / dataset
    base = (_ADDRESS if base_url is None else base_url).rstrip("/")
    return [_fetch(entry, target, base, progress) for entry in entries]


def salsa_pairs(folder: str | Path | None = None) -> list[Motion]:
    """Return CMU's ten salsa clips of two people.

    Searches ``folder``, by default the folders of :func:`data_places`, for all clips as archives
    (``cmu_60_61_TT.npz``, or below ``cmu_salsa_pairs``) or pairs of BVH files
    (``60_TT_scaled.bvh`` and ``61_TT_scaled.bvh``, or below ``cmu-salsa``). Nothing is downloaded.

    Returns
    -------
    list of Motion
        Clips of :data:`SALSA_TRIALS`, in this order, on ``pair17`` at 30 fps.

    Raises
    ------
    FileNotFoundError
        If the clips are missing; the message explains how to obtain them.
    """
    folders = data_places(folder)
    for candidate in folders:
        for archives in (candidate / "cmu_salsa_pairs", candidate):
            paths = [archives / f"cmu_60_61_{trial}.npz" for trial in SALSA_TRIALS]
            if all(path.is_file() for path in paths):
                return load_pairs(paths)
        for originals in (candidate / "cmu-salsa", candidate):
            couples = [
                [originals / f"{subject}_{trial}_scaled.bvh" for subject in (60, 61)]
                for trial in SALSA_TRIALS
            ]
            if all(path.is_file() for couple in couples for path in couple):
                return [read_salsa_bvh(lead, follow) for lead, follow in couples]
    raise FileNotFoundError(
        f"the ten salsa clips are not in {', '.join(map(str, folders))}; "
        'probmotion.data.downloads.download("cmu-salsa") downloads them, or pass their folder'
    )


@cache
def _registry() -> tuple[_Entry, ...]:
    with open(_REGISTRY, newline="", encoding="utf-8") as file:
        return tuple(_Entry(**line) for line in csv.DictReader(file))


def _chosen(dataset: str, names: Sequence[str] | None) -> list[_Entry]:
    entries = {entry.name: entry for entry in _registry() if entry.dataset == dataset}
    if not entries:
        known = dict.fromkeys(entry.dataset for entry in _registry())
        raise ValueError(f"dataset must be one of {', '.join(known)}, got {dataset!r}")
    if names is None:
        return list(entries.values())
    if isinstance(names, str):
        raise ValueError(f"names must be a list of names, got {names!r}")
    for name in names:
        if name not in entries:
            raise ValueError(
                f"names must be files of {dataset} ({', '.join(entries)}), got {name!r}"
            )
    return [entries[name] for name in names]


def _fetch(entry: _Entry, folder: Path, base: str, progress: bool) -> Path:
    """Return the path of a file, downloaded if missing."""
    import pooch
    import requests

    url = f"{base}/{entry.repository}/{entry.commit}/{entry.path}"
    download_one = partial(_write_response, size=int(entry.bytes), progress=progress)
    try:
        pooch.retrieve(
            url, known_hash=entry.sha256, fname=entry.name, path=folder, downloader=download_one
        )
    except _TooLarge as error:
        raise DownloadError(
            f"{entry.name} at {url} is larger than the {entry.bytes} bytes of the registry; the "
            "file was discarded"
        ) from error
    except requests.RequestException as error:
        reason: int | str = type(error).__name__
        if error.response is not None:
            reason = error.response.status_code
        raise DownloadError(
            f"{entry.name} cannot be downloaded from {url} ({reason}); check the network, pass "
            f"base_url= of a mirror, or put the file into {folder}"
        ) from error
    except ValueError as error:  # raised by pooch only for a wrong hash
        raise DownloadError(
            f"{entry.name} at {url} does not have the SHA-256 {entry.sha256} of the registry; the "
            "file was discarded"
        ) from error
    except OSError as error:
        raise DownloadError(
            f"{entry.name} from {url} cannot be written to {folder} "
            f"({error.strerror or type(error).__name__}); choose a writable folder"
        ) from error
    return folder / entry.name


def _write_response(url: str, path: str, caller: Any, *, size: int, progress: bool) -> None:
    """Write the response of a server to a file; raise if it has more than ``size`` bytes.

    ``caller`` is an argument of pooch.
    """
    import requests
    from tqdm import tqdm

    with (
        requests.get(url, stream=True, timeout=_TIMEOUT) as response,
        open(path, "wb") as file,
        tqdm(total=size, unit="B", unit_scale=True, disable=not progress) as bar,
    ):
        response.raise_for_status()
        left = size
        for chunk in response.iter_content(_CHUNK):
            left -= len(chunk)
            if left < 0:
                raise _TooLarge
            file.write(chunk)
            bar.update(len(chunk))
