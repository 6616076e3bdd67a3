"""`StoredReference`: reference draws of a long run, with a certificate of what they are.

A reference is a folder with ``draws.npz`` (``positions`` (n, L, J, 3), metres, float32) and
``certificate.json``. It is known to be of a posterior by that posterior's density at some of the
draws, which is the same on every machine to many digits, as the bits of a fitted prior are not; or,
where only θ has a density, by that of points to start from, and where their motions are.
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
    """A prior whose density of positions is known, whatever its θ is."""

    def log_prior(self, positions: Array) -> Array:
        """Return the log density of positions: ``(…, L, J, 3) → (…)``."""


@dataclass(frozen=True, eq=False)
class StoredReference:
    """Draws that were made once, and how they are known to be right.

    Parameters
    ----------
    positions : ndarray, (n, L, J, 3)
        The draws, nearly independent, metres.
    certificate : mapping
        ``problem``, ``draws``, ``exact``, ``sampler``, ``settings``, ``rhat``, ``ess_bulk``,
        ``ess_tail``, ``agreement`` of two independent runs (``agreement_wherever_they_stand``:
        of motions turned and moved onto each other), ``seed``, ``versions`` and ``fingerprint``.

    Raises
    ------
    ValueError
        If the draws are not finite or the certificate lacks something.
    """

    positions: np.ndarray
    certificate: Mapping[str, Any]

    def __post_init__(self) -> None:
        check_shape("positions", self.positions, ("n", "L", "J", 3))
        check_finite("positions", self.positions)
        lacking = [name for name in _NEEDED if name not in self.certificate]
        if lacking:
            raise ValueError(f"certificate lacks {', '.join(lacking)}, expected all of a reference")
        if self.certificate["draws"] != self.n:
            raise ValueError(
                f"certificate is of {self.certificate['draws']} draws, expected the {self.n} that "
                "are beside it"
            )

    @property
    def n(self) -> int:
        """Number of draws."""
        return len(self.positions)

    def choose(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n of the draws, without replacement, (n, L, J, 3), metres, float64.

        Raises
        ------
        ValueError
            If fewer are kept.
        """
        if n > self.n:
            name = self.certificate["problem"]
            raise ValueError(
                f"n is {n}, expected at most the {self.n} reference draws that are kept of {name}; "
                f"probmotion reference '{name}' --draws {n} makes more"
            )
        return self.positions[rng.permutation(self.n)[:n]].astype(np.float64)

    def check(self, name: str, posterior: MotionPosterior) -> None:
        """Raise ``ValueError`` unless the draws are of this posterior."""
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        wanted = self.certificate["fingerprint"]
        found = None
        if self.positions.shape[1:] == shape:
            found = fingerprint_of(posterior, self.positions)
        if found is None or not _same(found, wanted):
            raise ValueError(
                f"certificate is of another posterior than {name}'s ({wanted} beside {found}), "
                f"expected one of the same evidence and prior; probmotion reference '{name}' makes "
                "it"
            )

    def save(self, folder: str | Path) -> Path:
        """Write ``draws.npz`` and ``certificate.json`` into ``folder``, both or neither.

        Raises
        ------
        OSError
            If it cannot be written; what was there before stays.
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
            _take_the_place_of(unfinished, folder)
        except OSError as error:
            raise _unwritable(folder, error) from error
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> StoredReference:
        """Read what :meth:`save` wrote.

        Raises
        ------
        FileNotFoundError
            If a file is missing.
        ValueError
            If one is not what it should be.
        """
        folder = Path(folder)
        try:
            certificate = json.loads((folder / _CERTIFICATE).read_text(encoding="utf-8"))
            with np.load(folder / _DRAWS, allow_pickle=False) as held:
                positions = held["positions"]
            return cls(positions, dict(certificate))
        except (ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
            raise ValueError(
                f"{folder} holds no reference ({error}), expected {_DRAWS} and {_CERTIFICATE} that "
                "probmotion reference wrote"
            ) from error


def fingerprint_of(posterior: MotionPosterior, positions: np.ndarray) -> list[float]:
    """Return the numbers that a reference is known by.

    The posterior's log density at the first draws; where positions have none, that of four θ to
    start from, and the mean distance of their joints from the origin, metres. Of a density that is
    cut, the levels of the cuts as well.

    Raises
    ------
    ValueError
        If the prior has a density neither of positions nor of θ, or draws of it have none.
    """
    prior = posterior.prior
    if isinstance(prior, HasPositionDensity) or not isinstance(prior, HasLogDensity):
        # Whoever wrote them and whoever reads them must ask at the same points: as they are kept.
        some = np.asarray(positions[:_PROBES], dtype=np.float32).astype(np.float64)
        known = [log_density_at(posterior, some)]
    else:
        theta = prior.initial(seeds.generator(0, "fingerprint"), _PROBES)
        distances = np.linalg.norm(to_numpy(prior.motion(theta)), axis=-1)
        known = [to_numpy(posterior.log_density(theta)), distances.mean(axis=(1, 2))]
        if not np.isfinite(known).all():
            raise ValueError(
                f"posterior has log densities of {known[0].tolist()} at draws of its prior, "
                "expected finite ones, which a reference is known by"
            )
    if isinstance(posterior, TruncatedPosterior) and posterior.reshaped:
        known.append(np.array([posterior.log_floor, posterior.log_cap]))
    return [round(float(value), 6) for value in np.concatenate(known)]


def log_density_at(posterior: MotionPosterior, positions: np.ndarray) -> np.ndarray:
    """Return log p(X) + log p(y | X), up to a constant of y: ``(n, L, J, 3) → (n,)``.

    Raises
    ------
    ValueError
        If the prior has no density of positions.
    """
    prior, likelihood = posterior.prior, posterior.likelihood
    if not isinstance(prior, HasPositionDensity):
        raise ValueError(
            f"prior {type(prior).__name__} has no density, expected one of positions, "
            "log_prior(positions), or of θ, log_density(theta)"
        )
    value = to_numpy(prior.log_prior(positions))
    if likelihood is not None:
        value = value + to_numpy(likelihood.log_density(positions))
    return np.asarray(value)


def _same(found: list[float], wanted: Any) -> bool:
    if not isinstance(wanted, list) or len(found) != len(wanted):
        return False
    return bool(np.allclose(found, np.asarray(wanted, dtype=float), rtol=_TOLERANCE, atol=1e-3))


def _take_the_place_of(unfinished: Path, folder: Path) -> None:
    """Rename a folder to where another may be, which comes back if that fails."""
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
    reason = error.strerror or str(error)
    return OSError(f"cannot write {folder}: {reason}; expected a folder that is writable")
