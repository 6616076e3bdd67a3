"""Reference draws of long runs, stored with a certificate.

A reference is a folder with ``draws.npz`` (``positions`` (n, L, J, 3), metres, float32) and
``certificate.json``. Its fingerprint is the posterior's log density at some draws or, if only θ has
a density, at initial points; unlike the bits of a fitted prior, it is reproducible across machines.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from zipfile import BadZipFile

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, to_numpy
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.validation import check_finite, check_shape

__all__ = [
    "HasPositionDensity",
    "StoredReference",
    "fingerprint_of",
    "log_density_at",
]

_DRAWS, _CERTIFICATE = "draws.npz", "certificate.json"
_PROBES = 4
_TOLERANCE = 1e-5
_NEEDED = ("problem", "draws", "exact", "sampler", "settings", "agreement", "seed", "fingerprint")


@runtime_checkable
class HasPositionDensity(Protocol):
    """A prior with a density of positions."""

    def log_prior(self, positions: Array) -> Array:
        """Return the log density of positions: ``(…, L, J, 3) → (…)``."""


@dataclass(frozen=True, eq=False)
class StoredReference:
    """Stored reference draws with a certificate of their quality.

    Parameters
    ----------
    positions : ndarray, (n, L, J, 3)
        The draws, nearly independent, metres.
    certificate : mapping
        ``problem``, ``draws``, ``exact``, ``sampler``, ``settings``, ``rhat``, ``ess_bulk``,
        ``ess_tail``, ``agreement`` of two independent runs (``agreement_wherever_they_stand``:
        after rigid alignment), ``seed``, ``versions`` and ``fingerprint``.
    """

    positions: np.ndarray
    certificate: Mapping[str, Any]

    def __post_init__(self) -> None:
        check_shape("positions", self.positions, ("n", "L", "J", 3))
        check_finite("positions", self.positions)
        lacking = [name for name in _NEEDED if name not in self.certificate]
        if lacking:
            raise ValueError(f"certificate must have {', '.join(_NEEDED)}; missing {lacking}")
        if self.certificate["draws"] != self.n:
            raise ValueError(
                f"certificate must be of the {self.n} stored draws, got {self.certificate['draws']}"
            )

    @property
    def n(self) -> int:
        """Number of draws."""
        return len(self.positions)

    def choose(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n of the draws, without replacement, (n, L, J, 3), metres, float64."""
        if n > self.n:
            name = self.certificate["problem"]
            raise ValueError(
                f"n must be at most the {self.n} stored reference draws of {name}, got {n}; "
                f"make more with: probmotion reference '{name}' --draws {n}"
            )
        return self.positions[rng.permutation(self.n)[:n]].astype(np.float64)

    def check(self, name: str, posterior: MotionPosterior) -> None:
        """Raise ``ValueError`` unless the draws belong to this posterior."""
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        wanted = self.certificate["fingerprint"]
        found = None
        if self.positions.shape[1:] == shape:
            found = fingerprint_of(posterior, self.positions)
        if found is None or not _same(found, wanted):
            raise ValueError(
                f"certificate must have {name}'s fingerprint {found}, got {wanted}; make the "
                f"reference with: probmotion reference '{name}'"
            )

    def save(self, folder: str | Path) -> Path:
        """Write ``draws.npz`` and ``certificate.json`` into ``folder``, both or neither.

        Raises
        ------
        OSError
            If it cannot be written; an earlier reference is left intact.
        """
        folder = Path(folder)
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=folder.parent))
        except OSError as error:
            raise _unwritable(folder, error) from error
        try:
            np.savez_compressed(unfinished / _DRAWS, positions=self.positions.astype(np.float32))
            text = json.dumps(self.certificate, indent=1, allow_nan=False)
            (unfinished / _CERTIFICATE).write_text(text + "\n", encoding="utf-8")
            unfinished.chmod(0o755)
            _replace_folder(unfinished, folder)
        except OSError as error:
            raise _unwritable(folder, error) from error
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> StoredReference:
        """Read a reference written by :meth:`save`.

        Raises
        ------
        FileNotFoundError
            If a file is missing.
        ValueError
            If a file is invalid.
        """
        folder = Path(folder)
        try:
            certificate = json.loads((folder / _CERTIFICATE).read_text(encoding="utf-8"))
            with np.load(folder / _DRAWS, allow_pickle=False) as held:
                positions = held["positions"]
            return cls(positions, dict(certificate))
        except (ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
            raise ValueError(
                f"{folder} must hold {_DRAWS} and {_CERTIFICATE} of probmotion reference ({error})"
            ) from error


def fingerprint_of(posterior: MotionPosterior, positions: np.ndarray) -> list[float]:
    """Return the numbers that identify a reference's posterior.

    They are the log density at the first draws; without a density of positions, the log density at
    four initial θ and the mean distance of their joints from the origin, metres. The truncation
    levels are appended if there are any.

    Raises
    ------
    ValueError
        If the prior has no density, or it is not finite at the draws.
    """
    prior = posterior.prior
    if isinstance(prior, HasPositionDensity) or not isinstance(prior, HasLogDensity):
        # Evaluated at the points as stored, in float32.
        some = np.asarray(positions[:_PROBES], dtype=np.float32).astype(np.float64)
        known = [log_density_at(posterior, some)]
    else:
        theta = prior.initial(seeds.generator(0, "fingerprint"), _PROBES)
        distances = np.linalg.norm(to_numpy(prior.motion(theta)), axis=-1)
        known = [to_numpy(posterior.log_density(theta)), distances.mean(axis=(1, 2))]
        if not np.isfinite(known).all():
            raise ValueError(
                "posterior must have finite log densities at draws of its prior, got "
                f"{known[0].tolist()}"
            )
    if isinstance(posterior, TruncatedPosterior) and posterior.truncated:
        known.append(np.array([posterior.log_floor, posterior.log_cap]))
    return [round(float(value), 6) for value in np.concatenate(known)]


def log_density_at(posterior: MotionPosterior, positions: np.ndarray) -> np.ndarray:
    """Return log p(X) + log p(y | X), unnormalised: ``(n, L, J, 3) → (n,)``.

    Raises
    ------
    ValueError
        If the prior has no density of positions.
    """
    prior, likelihood = posterior.prior, posterior.likelihood
    if not isinstance(prior, HasPositionDensity):
        raise ValueError(
            "prior must have log_prior(positions) or log_density(theta), got "
            f"{type(prior).__name__}"
        )
    value = to_numpy(prior.log_prior(positions))
    if likelihood is not None:
        value = value + to_numpy(likelihood.log_density(positions))
    return np.asarray(value)


def _same(found: list[float], wanted: Any) -> bool:
    if not isinstance(wanted, list) or len(found) != len(wanted):
        return False
    return bool(np.allclose(found, np.asarray(wanted, dtype=float), rtol=_TOLERANCE, atol=1e-3))


def _replace_folder(unfinished: Path, folder: Path) -> None:
    """Rename a folder, replacing another, which is restored if that fails."""
    if not folder.exists():
        unfinished.rename(folder)
        return
    before = Path(tempfile.mkdtemp(prefix=".before-", dir=folder.parent))
    os.replace(folder, before)
    try:
        unfinished.rename(folder)
    except OSError:
        os.replace(before, folder)
        raise
    shutil.rmtree(before)


def _unwritable(folder: Path, error: OSError) -> OSError:
    return OSError(f"cannot write {folder}: {error.strerror or error}; choose a writable folder")
