"""Finished draws wrapped as a sampler, so that they can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.seeds import NormalStreams
from probmotion.validation import check_finite, check_shape

__all__ = ["FinishedDraws"]


@dataclass(frozen=True, eq=False)
class FinishedDraws:
    """A sampler that returns finished draws, whatever the posterior, seed and number.

    Construct it with :meth:`of`.

    Parameters
    ----------
    name : str
        Name in tables.
    positions : ndarray, (chains, draws, L, J, 3), optional
        Motions, metres; computed from ``theta`` if not given.
    theta : ndarray, (chains, draws, dim), optional
        Draws in the posterior's coordinates.
    independent : bool
        Whether draws are independent, so that R-hat does not apply.
    seconds : float
        Wall-clock time of the run; 0 if unknown.
    statistics : mapping of ndarray
        Arrays over (chain,) or (chain, draw).
    counts : mapping of int
        Evaluations by kind.
    """

    requires: ClassVar[tuple[type, ...]] = ()
    finished: ClassVar[bool] = True

    name: str
    positions: np.ndarray | None = None
    theta: np.ndarray | None = None
    independent: bool = False
    seconds: float = 0.0
    statistics: Mapping[str, np.ndarray] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, draws: Any, name: str = "draws") -> FinishedDraws:
        """Return finished draws.

        Parameters
        ----------
        draws : MotionDraws, xarray.DataTree or array
            Draws of this package; an ArviZ tree with ``positions`` or ``theta`` in its
            ``posterior``, or else variables that together are θ; or an array over positions,
            ([chain,] draw, frame, joint, axis), or over θ, ([chain,] draw, coordinate).
        name : str
            Name in tables, unless ``draws`` has one.

        Raises
        ------
        ValueError
            If ``draws`` has another type or shape, or a value is not finite.
        """
        if isinstance(draws, MotionDraws):
            return _of_motion_draws(draws)
        if "posterior" in getattr(draws, "children", ()):
            return _of_tree(draws, name)
        try:
            values = np.asarray(draws, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(())
        if values.ndim not in (2, 3, 4, 5):
            raise ValueError(
                "draws must be MotionDraws, an ArviZ tree, or an array over (chain, draw, frame, "
                f"joint, axis) or (chain, draw, coordinate), got {type(draws).__name__}"
                + (f" of shape {values.shape}" if values.ndim else "")
            )
        check_finite("draws", values)
        if values.ndim in (2, 4):
            values = values[None]
        return cls(name, theta=values) if values.ndim == 3 else cls(name, positions=values)

    def sample(
        self, posterior: MotionPosterior, *, seed: int = 0, **options: object
    ) -> MotionDraws:
        """Return the draws, as draws of ``posterior``; ``seed`` completes θ."""
        positions, theta = self.positions, self.theta
        if theta is not None:
            check_shape("theta", theta, ("chain", "draw", posterior.dim))
        if positions is None:
            assert theta is not None
            flat = theta.reshape(-1, posterior.dim)
            streams = NormalStreams.of_draws(
                seeds.integer(seed, "finished"), [(0, draw) for draw in range(len(flat))]
            )
            motions = posterior.complete(flat, streams)
            positions = motions.reshape(*theta.shape[:2], *motions.shape[1:])
        statistics = dict(self.statistics)
        return MotionDraws.of(
            posterior,
            self,
            positions,
            seed=seed,
            seconds=self.seconds,
            theta=theta,
            log_density=statistics.pop("log_density", None),
            statistics=statistics,
            counts=self.counts,
            independent=self.independent,
        )


def _of_motion_draws(draws: MotionDraws) -> FinishedDraws:
    data = draws.dataset
    statistics = {
        str(name): values.values
        for name, values in data.data_vars.items()
        if values.dims in (("chain",), ("chain", "draw"))
    }
    return FinishedDraws(
        str(data.attrs["sampler"]),
        positions=data["positions"].values,
        theta=data["theta"].values if "theta" in data else None,
        independent=draws.independent,
        seconds=draws.seconds,
        statistics=statistics,
        counts=draws.counts,
    )


def _of_tree(tree: Any, name: str) -> FinishedDraws:
    """Return the draws and statistics of an ArviZ tree."""
    first = ("chain", "draw")
    data: xr.Dataset = tree["posterior"].to_dataset()
    if not {*first} <= set(data.dims):
        raise ValueError(f"posterior must have the dimensions chain and draw, got {set(data.dims)}")
    data = data.transpose(*first, ...)
    positions = data["positions"].values if "positions" in data else None
    theta = data["theta"].values if "theta" in data else None
    if positions is None and theta is None:
        parts = [values.values for values in data.data_vars.values() if values.dims[:2] == first]
        theta = np.concatenate([part.reshape(*part.shape[:2], -1) for part in parts], axis=-1)
    for label, values in (("positions", positions), ("theta", theta)):
        if values is not None:
            check_finite(label, values)
    statistics = {}
    if "sample_stats" in tree.children:
        for label, values in tree["sample_stats"].data_vars.items():
            if {*values.dims} in ({"chain"}, {*first}):
                stored = "log_density" if label == "lp" else str(label)
                statistics[stored] = values.transpose(*first, missing_dims="ignore").values
    return FinishedDraws(
        str(data.attrs.get("sampler", name)),
        positions=positions,
        theta=theta,
        independent=bool(data.attrs.get("independent", False)),
        seconds=float(data.attrs.get("sampling_time", 0.0)),
        statistics=statistics,
    )
