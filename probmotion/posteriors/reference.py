"""Reference draws of long runs, stored with a certificate.

A reference is a folder with ``draws.npz`` (``positions`` (n, L, J, 3), metres, float32) and
``certificate.json``. The certificate contains a fingerprint of the posterior (see
``fingerprint_of``) that is reproducible across machines, unlike a hash of the prior, and the
checksum of ``draws.npz``.
"""

from __future__ import annotations

import json
import os
import tempfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, to_numpy
from probmotion.files import check_format, read_arrays, read_json, write_errors, write_json
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasLogDensity
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.validation import check_finite, check_shape

__all__ = ["HasPositionDensity", "StoredReference", "fingerprint_of", "log_density_at"]

_DRAWS, _CERTIFICATE = "draws.npz", "certificate.json"
_NEW = ".new.npz"  # draws that replace draws.npz once their certificate is written
_CHECKSUM = "draws_crc32"  # of the file of draws, in the file of the certificate
_PROBES = 4  # points at which a fingerprint is evaluated
_TOLERANCE = 1e-5  # relative tolerance of fingerprints
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
        Nearly independent draws, metres.
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
        missing = [name for name in _NEEDED if name not in self.certificate]
        if missing:
            raise ValueError(f"certificate must have {', '.join(_NEEDED)}, got none of {missing}")
        fingerprint = self.certificate["fingerprint"]
        if not isinstance(fingerprint, list) or not all(
            isinstance(number, int | float) for number in fingerprint
        ):
            raise ValueError(f"fingerprint must be a list of numbers, got {fingerprint!r:.80}")
        for name, kind in (("sampler", str), ("rhat", int | float | None)):
            if not isinstance(self.certificate.get(name), kind):
                value = self.certificate.get(name)
                raise ValueError(f"{name} of the certificate is invalid: {value!r:.80}")
        if self.certificate["draws"] != self.n:
            raise ValueError(
                f"certificate must be of the {self.n} stored draws, got {self.certificate['draws']}"
            )

    @property
    def n(self) -> int:
        """Number of draws."""
        return len(self.positions)

    def choose(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n draws chosen without replacement, (n, L, J, 3), metres, float64."""
        if n > self.n:
            name = self.certificate["problem"]
            raise ValueError(
                f"n must be at most the {self.n} stored reference draws of {name}, got {n}; "
                f"create more with: probmotion reference '{name}' --draws {n}"
            )
        return self.positions[rng.permutation(self.n)[:n]].astype(np.float64)

    def check(self, name: str, posterior: MotionPosterior) -> None:
        """Raise ``ValueError`` unless the draws belong to this posterior."""
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        stored, expected = self.certificate["fingerprint"], None
        if self.positions.shape[1:] == shape:
            expected = fingerprint_of(posterior, self.positions)
        if expected is None or not _same(expected, stored):
            raise ValueError(
                f"certificate must have {name}'s fingerprint {expected}, got {stored}; create "
                f"the reference with: probmotion reference '{name}'"
            )

    def save(self, folder: str | Path) -> Path:
        """Write both files into ``folder``, which has the earlier or the new reference at any time.

        The new certificate replaces the earlier one, and with it the draws: those with its
        checksum.
        """
        folder = Path(folder)
        json.dumps(self.certificate, allow_nan=False)  # raises ValueError for NaN
        with write_errors(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder.parent) as temporary:
                draws, certificate = Path(temporary, _DRAWS), Path(temporary, _CERTIFICATE)
                np.savez_compressed(draws, positions=self.positions.astype(np.float32))
                write_json(
                    certificate, {"format": 1, **self.certificate, _CHECKSUM: _checksum(draws)}
                )
                folder.mkdir(exist_ok=True)
                os.replace(draws, folder / _NEW)
                os.replace(certificate, folder / _CERTIFICATE)
            # Another process that writes the same reference may have renamed them.
            with suppress(FileNotFoundError):
                os.replace(folder / _NEW, folder / _DRAWS)
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> StoredReference:
        """Read a reference written by :meth:`save`; raise ``ValueError`` if a file is invalid."""
        folder = Path(folder)
        try:
            certificate = dict(read_json(folder / _CERTIFICATE))
            check_format(certificate)
            # References of earlier versions have no checksum.
            checksum, path = certificate.pop(_CHECKSUM, None), folder / _NEW
            if checksum is None or not path.exists() or _checksum(path) != checksum:
                path = folder / _DRAWS
            if checksum is not None and _checksum(path) != checksum:
                raise ValueError(f"the checksum of {_DRAWS} is not that in the certificate")
            return cls(read_arrays(path)["positions"], certificate)
        except (ValueError, KeyError, TypeError) as error:
            files = f"{_DRAWS} and {_CERTIFICATE} of probmotion reference"
            raise ValueError(f"{folder} must contain {files} ({str(error)[:200]})") from error


def _checksum(path: Path) -> str:
    return f"{zlib.crc32(path.read_bytes()):08x}"


def fingerprint_of(posterior: MotionPosterior, positions: np.ndarray) -> list[float]:
    """Return the fingerprint of a reference's posterior.

    The fingerprint is the log density at the first draws or, without a density of positions, the
    log density at four initial θ and the mean distance of their joints from the origin, metres. The
    truncation levels of a truncated posterior are appended.
    """
    prior = posterior.prior
    if isinstance(prior, HasPositionDensity) or not isinstance(prior, HasLogDensity):
        # Evaluate at the positions as stored, in float32.
        stored = np.asarray(positions[:_PROBES], dtype=np.float32).astype(np.float64)
        numbers = [log_density_at(posterior, stored)]
    else:
        theta = prior.initial(seeds.generator(0, "fingerprint"), _PROBES)
        distances = np.linalg.norm(to_numpy(prior.motion(theta)), axis=-1)
        numbers = [to_numpy(posterior.log_density(theta)), distances.mean(axis=(1, 2))]
        if not np.isfinite(numbers).all():
            raise ValueError(
                "posterior must have finite log densities at draws of its prior, got "
                f"{numbers[0].tolist()}"
            )
    if isinstance(posterior, TruncatedPosterior) and posterior.truncated:
        numbers.append(np.array([posterior.log_floor, posterior.log_cap]))
    return [round(float(value), 6) for value in np.concatenate(numbers)]


def log_density_at(posterior: MotionPosterior, positions: np.ndarray) -> np.ndarray:
    """Return log p(X) + log p(y | X), unnormalised: ``(n, L, J, 3) → (n,)``."""
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


def _same(fingerprint: list[float], stored: Any) -> bool:
    if not isinstance(stored, list) or len(fingerprint) != len(stored):
        return False
    numbers = np.asarray(stored, dtype=float)
    return bool(np.allclose(fingerprint, numbers, rtol=_TOLERANCE, atol=1e-3))
