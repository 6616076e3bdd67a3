"""Draws of a sampler, with statistics and provenance."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from probmotion.files import UNSEALED, sealed, write_seal, written_whole
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.arviz_groups import observation_groups, posterior_groups
from probmotion.posteriors.protocols import Likelihood
from probmotion.validation import check_count, check_finite, check_positive, check_shape

if TYPE_CHECKING:
    from probmotion.posteriors.posterior import MotionPosterior

__all__ = ["MotionDraws", "check_same_run", "library_versions", "settings_of"]

_VERSION = 1  # of the file format
_DIMS: tuple[str, ...] = ("chain", "draw", "frame", "joint", "axis")  # of positions


@dataclass(frozen=True, eq=False)
class MotionDraws:
    """Draws of a sampler over (chain, draw, frame, joint, axis), with statistics and provenance.

    Parameters
    ----------
    dataset : xarray.Dataset
        ``positions`` (chain, draw, frame, joint, axis), metres; optionally ``theta`` (chain, draw,
        coordinate), ``log_density`` (chain, draw), statistics per draw (chain, draw) or chain
        (chain), and ``state_*``, the sampler state for continuation. Attributes: skeleton, fps,
        sampler, settings, seed, versions, seconds and evaluation counts.
    likelihood : Likelihood, optional
        Likelihood of the posterior, for :meth:`to_arviz`; not stored in files.
    """

    dataset: xr.Dataset
    likelihood: Likelihood | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        posterior: MotionPosterior,
        sampler: Any,
        positions: np.ndarray,
        *,
        seed: int,
        seconds: float,
        theta: np.ndarray | None = None,
        log_density: np.ndarray | None = None,
        statistics: Mapping[str, np.ndarray] | None = None,
        counts: Mapping[str, int] | None = None,
        state: Mapping[str, np.ndarray] | None = None,
        independent: bool = False,
    ) -> MotionDraws:
        """Return the draws of a finished run.

        Parameters
        ----------
        posterior, sampler
            Target and sampler; the fields of the sampler, a dataclass, are stored as the settings.
        positions : ndarray, (chains, draws, L, J, 3)
            Metres.
        seed, seconds
            Seed and wall-clock time of the run.
        theta : ndarray, (chains, draws, dim), optional
            Draws in the posterior's coordinates.
        log_density : ndarray, (chains, draws), optional
            log p(θ) + log p(y | θ) of each draw.
        statistics : mapping of ndarray, optional
            Arrays over (chain,) or (chain, draw), named as in ArviZ: ``acceptance_rate``,
            ``diverging``, ``n_steps``, ``energy``, …
        counts : mapping of int, optional
            Numbers of evaluations of ``denoiser``, ``density`` and ``gradient``, counted per
            motion (2D denoiser: per view).
        state : mapping of ndarray, optional
            Sampler state from which the run can be continued.
        independent : bool
            Whether draws are independent by construction, so that chain diagnostics do not apply.
        """
        skeleton = posterior.skeleton
        positions = np.asarray(positions, dtype=np.float64)
        check_shape(
            "positions", positions, ("chain", "draw", posterior.frames, skeleton.n_joints, 3)
        )
        check_finite("positions", positions)
        shape = positions.shape[:2]
        axes = _DIMS
        data = {"positions": (axes, positions)}
        if theta is not None:
            check_shape("theta", theta, (*shape, posterior.dim))
            data["theta"] = (("chain", "draw", "coordinate"), theta)
        if log_density is not None:
            check_shape("log_density", log_density, shape)
            data["log_density"] = (("chain", "draw"), log_density)
        for name, values in (statistics or {}).items():
            values = np.asarray(values)
            check_shape(name, values, shape[: values.ndim])
            data[name] = (("chain", "draw")[: values.ndim], values)
        for name, values in (state or {}).items():
            values = np.asarray(values)
            axes = tuple(f"state_{name}_{axis}" for axis in range(values.ndim))
            data[f"state_{name}"] = (axes, values)
        attributes = {
            "format": "probmotion draws",
            "format_version": _VERSION,
            "sampler": sampler.name,
            "settings": json.dumps(settings_of(sampler), sort_keys=True),
            "seed": int(seed),
            "seconds": float(seconds),
            "independent": int(independent),
            "fps": float(posterior.fps),
            "parents": np.asarray(skeleton.parents, dtype=np.int32),
            "versions": json.dumps(library_versions(), sort_keys=True),
        }
        if skeleton.radii is not None:
            attributes["radii"] = np.asarray(skeleton.radii)
        for name, count in (counts or {}).items():
            attributes[f"evaluations_{name}"] = int(count)
        coordinates = {
            "chain": np.arange(shape[0]),
            "draw": np.arange(shape[1]),
            "frame": np.arange(posterior.frames),
            "joint": list(skeleton.joint_names),
            "axis": ["x", "y", "z"],
        }
        return cls(xr.Dataset(data, coordinates, attributes), posterior.likelihood)

    @property
    def positions(self) -> xr.DataArray:
        """Joint positions of the draws, (chain, draw, frame, joint, axis), metres."""
        return self.dataset["positions"]

    @property
    def skeleton(self) -> Skeleton:
        """Skeleton of the draws."""
        names = [str(name) for name in self.dataset["joint"].values]
        parents = np.atleast_1d(self.dataset.attrs["parents"]).tolist()
        radii = self.dataset.attrs.get("radii")
        return Skeleton(names, parents, None if radii is None else np.atleast_1d(radii).tolist())

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.dataset.attrs["fps"])

    @property
    def seconds(self) -> float:
        """Wall-clock time of the run, seconds."""
        return float(self.dataset.attrs["seconds"])

    @property
    def independent(self) -> bool:
        """Whether the draws are independent by construction, not states of a Markov chain."""
        return bool(self.dataset.attrs["independent"])

    @property
    def counts(self) -> dict[str, int]:
        """Number of evaluations by kind: ``denoiser``, ``density``, ``gradient``."""
        counts = _with_prefix("evaluations_", self.dataset.attrs)
        return {name: int(count) for name, count in counts.items()}

    @property
    def state(self) -> dict[str, np.ndarray]:
        """Sampler state from which the run can be continued."""
        state = _with_prefix("state_", self.dataset.data_vars)
        return {name: values.values for name, values in state.items()}

    def flat(self) -> np.ndarray:
        """Return all draws, (chains × draws, L, J, 3), chain by chain."""
        positions = self.positions.values
        return positions.reshape(-1, *positions.shape[2:])

    def motion(self, draw: int, chain: int = 0) -> Motion:
        """Return one draw as a :class:`~probmotion.Motion`."""
        positions = self.positions.isel(chain=chain, draw=draw).values
        return self._motion(positions, f"{chain}-{draw}")

    def playback(self, chain: int = 0) -> Motion:
        """Return a chain's draws concatenated into one motion, for animation."""
        chains = self.positions.sizes["chain"]
        if not 0 <= chain < chains:
            raise ValueError(f"chain must be between 0 and {chains - 1}, got {chain!r}")
        positions = self.positions.isel(chain=chain).values
        return self._motion(positions.reshape(-1, *positions.shape[2:]), f"{chain}")

    def _motion(self, positions: np.ndarray, name: str) -> Motion:
        name = f"{self.dataset.attrs['sampler']}-{name}"
        return Motion(positions, self.skeleton, self.fps, name=name)

    def motions(self) -> Iterator[Motion]:
        """Yield every draw as a motion, chain by chain."""
        for chain in range(self.dataset.sizes["chain"]):
            for draw in range(self.dataset.sizes["draw"]):
                yield self.motion(draw, chain)

    def to_arviz(self, likelihood: Likelihood | None = None) -> xr.DataTree:
        """Return an ArviZ tree.

        The groups are ``posterior`` (positions, theta), ``sample_stats`` (``lp``,
        ``acceptance_rate``, ``diverging``, ``n_steps``, ``energy``, as far as the sampler has
        them), and, for :class:`~probmotion.Keypoints2D` and :class:`~probmotion.Joints3D`,
        ``log_likelihood`` and ``observed_data`` over the ``observation`` of visible entries, which
        has the coordinates ``view``, ``frame`` and ``joint``.

        Parameters
        ----------
        likelihood : Likelihood, optional
            Likelihood of draws loaded from a file; by default that of the sampled posterior.
        """
        likelihood = self.likelihood if likelihood is None else likelihood
        groups = posterior_groups(self.dataset)
        if likelihood is not None:
            groups |= observation_groups(likelihood, self.positions)
        return xr.DataTree.from_dict(groups)

    def citations(self) -> list[str]:
        """Return the works to cite for these draws."""
        from probmotion.citations import citations_of

        attributes, names = self.dataset.attrs, self.skeleton.canonical_names
        people = sum(names[root].endswith("pelvis") for root in self.skeleton.roots)
        return citations_of(attributes["sampler"], attributes["settings"], people)

    def save(self, path: str | Path) -> None:
        """Write the draws atomically as netCDF; ``path`` must end in ``.nc``."""
        if Path(path).suffix != ".nc":
            raise ValueError(f"path must end in .nc, got {str(path)!r}")
        # NetCDF integers have 32 bits, which seeds and counts may exceed.
        large = {
            str(name): str(value)
            for name, value in self.dataset.attrs.items()
            if isinstance(value, int) and not -(2**31) <= value < 2**31
        }
        with written_whole(Path(path)) as unfinished:
            stored = self.dataset.assign_attrs(large, checksum=UNSEALED)
            stored.to_netcdf(unfinished, engine="scipy")
            write_seal(unfinished)

    @classmethod
    def load(cls, path: str | Path) -> MotionDraws:
        """Read draws written by :meth:`save`; raise ``ValueError`` if the file is invalid."""
        try:
            with xr.open_dataset(path, engine="scipy") as opened:
                dataset = opened.load()
        except FileNotFoundError:
            raise
        except Exception as error:
            raise ValueError(f"path must be a netCDF file of draws, got {str(path)!r}") from error
        got = dataset.attrs.get("format_version")
        if got != _VERSION:
            raise ValueError(f"{path} must have format version {_VERSION}, got {got}")
        seal = dataset.attrs.pop("checksum", None)  # files of earlier versions have none
        if seal is not None and sealed(Path(path), str(seal)) != seal:
            raise ValueError(f"{path} is damaged: the checksum does not match")
        try:
            counts = [name for name in dataset.attrs if str(name).startswith("evaluations_")]
            draws = cls(dataset.assign_attrs({n: int(dataset.attrs[n]) for n in ["seed", *counts]}))
            draws._check()
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{path} must be a valid file of draws: {str(error)[:200]}") from error
        return draws

    def _check(self) -> None:
        """Raise an error unless the variables and attributes of a file are complete and valid."""
        dims, skeleton = self.positions.dims, self.skeleton
        if dims != _DIMS:
            raise ValueError(f"positions must have the dimensions {', '.join(_DIMS)}, got {dims}")
        check_shape("positions", self.positions, ("c", "d", "L", skeleton.n_joints, 3))
        check_count("number of draws", self.positions.size)
        check_finite("positions", self.positions.values)
        check_positive("fps", self.fps)
        for name in ("sampler", "settings", "seconds", "independent"):
            kind = str if name in ("sampler", "settings") else int | float | np.number
            if not isinstance(self.dataset.attrs[name], kind):
                raise TypeError(f"{name} must be one value")


def _with_prefix(prefix: str, entries: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the entries with names that begin with ``prefix``, without the prefix."""
    names = [str(name) for name in entries if str(name).startswith(prefix)]
    return {name.removeprefix(prefix): entries[name] for name in names}


def check_same_run(sampler: Any, initial: MotionDraws, chains: int, seed: int) -> None:
    """Raise ``ValueError`` unless ``initial`` has this sampler, seed and number of chains."""
    attributes = initial.dataset.attrs
    settings = settings_of(sampler)
    for name, value, earlier in (
        ("sampler", sampler.name, attributes["sampler"]),
        ("settings", settings, json.loads(attributes["settings"])),
        ("seed", seed, int(attributes["seed"])),
        ("chains", chains, initial.dataset.sizes["chain"]),
    ):
        if value != earlier:
            raise ValueError(
                f"{name} must be {earlier}, as in the run to be continued, got {value}; start a "
                "new run to change it"
            )


def settings_of(sampler: Any) -> dict[str, Any]:
    """Return a sampler's settings as JSON values; empty if it is not a dataclass."""
    if not is_dataclass(sampler) or isinstance(sampler, type):
        return {}
    return json.loads(json.dumps(asdict(sampler), default=repr))


@cache
def library_versions() -> dict[str, str]:
    """Return the versions of the installed packages that draws and their metrics depend on."""
    samplers = ("probmotion", "numpy", "scipy", "numba", "jax", "numpyro", "emcee", "torch")
    versions = {}
    for package in (*samplers, "arviz-stats"):
        # Without its extra, a package is not installed.
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions
