"""The command ``probmotion reference``: reference draws of a problem, with their certificate.

It is a dataclass whose fields are its options, as in :mod:`probmotion.cli`.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

__all__ = ["Reference"]


@dataclass(frozen=True)
class Reference:
    """Make reference draws of a problem by two long runs that must agree, or exactly.

    Writes NAME/draws.npz and NAME/certificate.json, both or neither; what has not mixed or does
    not agree is not kept. A run that has ended is kept until both have, and pose-pairs before, so
    that the same command goes on after an interrupt.
    """

    problem: Positional[str]
    """Name of a problem (see probmotion list), or one with other numbers in quotes, such as
    "gait-noisy3d(noise=0.05)"."""

    draws: int = 4000
    """Draws in all, a multiple of 8."""

    seed: int = 0
    """Seed of the runs."""

    out: Path | None = None
    """Folder in which the problem's own is made; by default where comparisons look for it, in the
    user's cache."""

    def run(self) -> None:
        """Draw, certify, write, and say what is known of the draws."""
        from probmotion.problems.catalogue import problem_without_reference
        from probmotion.problems.references.making import ReferenceRefused, make_reference
        from probmotion.problems.references.store import references_folder
        from probmotion.threads import one_thread

        # Called as it calls itself, whatever order its numbers were given in.
        problem = problem_without_reference(self.problem)
        name = problem.name
        folder = (references_folder() if self.out is None else self.out) / name
        unfinished = folder.with_name(f".unfinished-{name}-{self.draws}-draws-seed-{self.seed}")
        try:
            with one_thread():
                reference = make_reference(
                    problem, draws=self.draws, seed=self.seed, unfinished=unfinished
                )
            reference.save(folder)
        except ReferenceRefused:
            # The same runs would be refused again.
            shutil.rmtree(unfinished)
            raise
        except KeyboardInterrupt as stop:
            if unfinished.is_dir() and any(unfinished.iterdir()):
                raise KeyboardInterrupt(
                    "interrupted; what was made is kept, and the same command goes on"
                ) from stop
            raise
        else:
            shutil.rmtree(unfinished)
        finally:
            # Where no run has ended nothing is left.
            with suppress(OSError):
                unfinished.rmdir()
        told = reference.certificate
        agreed = told["agreement"]
        print(f"{name}: {reference.n} draws by {told['sampler']}, kept in {folder}")
        if told["rhat"] is not None:
            print(f"  R-hat {told['rhat']:.4f}, least ESS {told['ess_bulk']:.0f}")
        print(f"  two runs apart: {_apart(agreed)}")
        if told["agreement_wherever_they_stand"] is not None:
            print(f"  wherever motions stand: {_apart(told['agreement_wherever_they_stand'])}")


def _apart(agreed: Mapping[str, float]) -> str:
    return (
        f"sliced Wasserstein ratio {agreed['swd_ratio']:.2f} (at most "
        f"{agreed['swd_ratio_at_most']:.2f}), means {agreed['mean_z']:.1f} standard errors (at "
        f"most {agreed['mean_z_at_most']:.1f})"
    )
