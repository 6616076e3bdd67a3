"""Public motions by name: files of the CMU database, fetched when asked for, checked, kept.

The registry beside this module lists where each file is (repository, commit, path), its SHA-256
and its size. Nothing is fetched unless :func:`download` is called.

The data are Carnegie Mellon University's (:data:`CMU_TERMS`); who publishes results obtained with
them is asked for the sentence :data:`CMU_ACKNOWLEDGEMENT`.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

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
"""What CMU asks to be added to the acknowledgements of a publication."""

CMU_TERMS = (
    "This data is free for use in research and commercial projects worldwide. If you publish "
    "results obtained using this data, we would appreciate it if you would send the citation to "
    "your published paper to jkh+mocap@cs.cmu.edu, and also would add this text to your "
    f'acknowledgments section: "{CMU_ACKNOWLEDGEMENT}"'
)
"""CMU's terms, as its database states them. The data themselves may not be sold."""

SALSA_TRIALS = ("01", "02", "03", "04", "05", "06", "07", "09", "10", "11")
"""The trials of :func:`salsa_pairs`; the registry has 12 to 15 too, and lacks 08."""

_ADDRESS = "https://raw.githubusercontent.com"
_FOLDER_VARIABLE = "PROBMOTION_DATA"
_REGISTRY = Path(__file__).with_name("registry.csv")
_PATIENCE = 30.0  # seconds without a byte


class DownloadError(OSError):
    """A file could not be fetched, or is not the one expected: one sentence with its address."""


@dataclass(frozen=True)
class _Entry:
    """A line of the registry."""

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
    """Return where downloads are kept.

    The folder that the environment variable ``PROBMOTION_DATA`` names, or the user's cache.
    """
    import pooch

    return Path(os.environ.get(_FOLDER_VARIABLE) or pooch.os_cache("probmotion"))


def data_places(folder: str | Path | None = None) -> list[Path]:
    """Return where clips of known names are looked for, the first place first.

    Parameters
    ----------
    folder : str or Path, optional
        Looked at and nothing else, if given. By default: the folder that the environment variable
        ``PROBMOTION_DATA`` names; ``../shared/data`` beside the current directory; the cache of
        :func:`download`.
    """
    if folder is not None:
        return [Path(folder)]
    named = os.environ.get(_FOLDER_VARIABLE)
    places = [*([Path(named)] if named else []), Path("../shared/data"), data_folder()]
    return list(dict.fromkeys(places))


def download(
    dataset: str = "cmu-salsa",
    names: Sequence[str] | None = None,
    folder: str | Path | None = None,
    base_url: str | None = None,
    progress: bool = False,
) -> list[Path]:
    """Fetch files of a data set, check their SHA-256 and return where they are.

    A file that is there and has the right SHA-256 is not fetched again. Each appears whole or not
    at all; what was finished before an interruption stays. CMU's terms hold (:data:`CMU_TERMS`).

    Parameters
    ----------
    dataset : str
        ``"cmu-salsa"`` (BVH, subjects 60 and 61) or ``"cmu-01-02-03"`` (ASF and AMC).
    names : sequence of str, optional
        Files, such as ``"60_10_scaled.bvh"``; all by default (71 and 62 MB).
    folder : str or Path, optional
        Where to keep them, below it in a folder called after the data set; by default
        :func:`data_folder`.
    base_url : str, optional
        Address of a mirror, before ``/repository/commit/path``; GitHub's by default.
    progress : bool
        Whether to show a bar for each file.

    Returns
    -------
    list of Path
        In the order of ``names``, or of the registry.

    Raises
    ------
    ValueError
        If the data set or a name is unknown.
    DownloadError
        If a file cannot be fetched or written, or has another SHA-256; the message names the file
        and the address.
    """
    entries = _chosen(dataset, names)
    place = (data_folder() if folder is None else Path(folder)) / dataset
    base = (_ADDRESS if base_url is None else base_url).rstrip("/")
    return [_fetch(entry, place, base, progress) for entry in entries]


def salsa_pairs(folder: str | Path | None = None) -> list[Motion]:
    """Return CMU's ten salsa clips of two people, from where they are found first.

    Looked at are the folders of :func:`data_places`. One holds the clips if all ten are there, as
    archives (``cmu_60_61_TT.npz``, or below ``cmu_salsa_pairs``) or as pairs of BVH files
    (``60_TT_scaled.bvh`` and ``61_TT_scaled.bvh``, or below ``cmu-salsa``).

    Parameters
    ----------
    folder : str or Path, optional
        Where they are.

    Returns
    -------
    list of Motion
        The trials :data:`SALSA_TRIALS` on ``pair17``, 30 fps, ``cmu_60_61_01`` first.

    Raises
    ------
    FileNotFoundError
        If they are nowhere; the message says how to get them. Nothing is fetched.
    """
    places = data_places(folder)
    for place in places:
        for archives in (place / "cmu_salsa_pairs", place):
            paths = [archives / f"cmu_60_61_{trial}.npz" for trial in SALSA_TRIALS]
            if all(path.is_file() for path in paths):
                return load_pairs(paths)
        for originals in (place / "cmu-salsa", place):
            couples = [
                [originals / f"{subject}_{trial}_scaled.bvh" for subject in (60, 61)]
                for trial in SALSA_TRIALS
            ]
            if all(path.is_file() for couple in couples for path in couple):
                return [read_salsa_bvh(lead, follow) for lead, follow in couples]
    raise FileNotFoundError(
        f"the ten salsa clips are not in {', '.join(map(str, places))}; "
        'probmotion.data.downloads.download("cmu-salsa") fetches them, or give the folder that '
        "holds them"
    )


@cache
def _registry() -> tuple[_Entry, ...]:
    with open(_REGISTRY, newline="", encoding="utf-8") as file:
        return tuple(_Entry(**line) for line in csv.DictReader(file))


def _chosen(dataset: str, names: Sequence[str] | None) -> list[_Entry]:
    """Return the registry's entries of a data set, all or those named."""
    known = list(dict.fromkeys(entry.dataset for entry in _registry()))
    if dataset not in known:
        raise ValueError(f"dataset must be one of {', '.join(known)}, got {dataset!r}")
    entries = {entry.name: entry for entry in _registry() if entry.dataset == dataset}
    if names is None:
        return list(entries.values())
    if isinstance(names, str):
        raise ValueError(f"names must be a list of names, got {names!r}")
    for name in names:
        if name not in entries:
            raise ValueError(
                f"names has {name!r}, expected files of {dataset}: {', '.join(entries)}"
            )
    return [entries[name] for name in names]


def _fetch(entry: _Entry, place: Path, base: str, progress: bool) -> Path:
    """Return the path of an entry's file, fetched unless it is there."""
    import pooch
    import requests

    url = f"{base}/{entry.repository}/{entry.commit}/{entry.path}"
    try:
        # It is written under another name, and moved to its own once the hash is right.
        pooch.retrieve(
            url,
            known_hash=entry.sha256,
            fname=entry.name,
            path=place,
            downloader=pooch.HTTPDownloader(progressbar=progress, timeout=_PATIENCE),
        )
    except requests.RequestException as error:
        answer: int | str = type(error).__name__
        if error.response is not None:  # which pooch leaves open where a file is not there
            answer = error.response.status_code
            error.response.close()
        raise DownloadError(
            f"{entry.name} cannot be fetched from {url} ({answer}), expected a network that "
            f"reaches it, base_url= of a mirror, or the file in {place}"
        ) from error
    except ValueError as error:  # pooch raises no other
        raise DownloadError(
            f"{entry.name} at {url} has not the SHA-256 {entry.sha256} of the registry, expected "
            "the file unchanged; nothing of it was kept"
        ) from error
    except OSError as error:
        raise DownloadError(
            f"{entry.name} from {url} cannot be kept in {place} "
            f"({error.strerror or type(error).__name__}), expected a folder that is writable"
        ) from error
    return place / entry.name
