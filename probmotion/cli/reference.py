"""The command ``probmotion reference``: certified reference draws of a problem."""

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
    """Generate reference draws of a problem, exactly or by two long runs that must agree.

    Writes NAME/draws.npz and NAME/certificate.json, or nothing if the runs have not converged or
    disagree. Run the same command again to resume after an interruption.
    """

    problem: Positional[str]
    """Name of a problem (see probmotion list), such as gait or "gait-noisy3d(noise=0.05)"."""

    draws: int = 4000
    """Total number of draws, a multiple of 8."""

    seed: int = 0
    """Random seed."""

    out: Path | None = None
    """Parent of the output folder; by default the reference store in the user's cache."""

    def run(self) -> None:
        from probmotion.problems.catalogue import problem_without_reference
        from probmotion.problems.references.making import ReferenceRefused, make_reference
        from probmotion.problems.references.store import references_folder
        from probmotion.threads import one_thread

        # The canonical name does not depend on the order of the parameters.
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
            # Repeating the runs would yield the same result.
            shutil.rmtree(unfinished)
            raise
        except KeyboardInterrupt as stop:
            if unfinished.is_dir() and any(unfinished.iterdir()):
                raise KeyboardInterrupt(
                    "interrupted; finished runs are stored, repeat the command to continue"
                ) from stop
            raise
        else:
            shutil.rmtree(unfinished)
        finally:
            # Remove the folder if no run has finished.
            with suppress(OSError):
                unfinished.rmdir()
        certificate = reference.certificate
        print(f"{name}: wrote {reference.n} draws by {certificate['sampler']} to {folder}")
        if certificate["rhat"] is not None:
            print(f"  R-hat {certificate['rhat']:.4f}, minimum ESS {certificate['ess_bulk']:.0f}")
        print(f"  agreement of two runs: {_described(certificate['agreement'])}")
        if (centred := certificate["agreement_wherever_they_stand"]) is not None:
            print(f"  agreement up to translation: {_described(centred)}")


def _described(agreement: Mapping[str, float]) -> str:
    return (
        f"sliced Wasserstein ratio {agreement['swd_ratio']:.2f} (at most "
        f"{agreement['swd_ratio_at_most']:.2f}), mean difference {agreement['mean_z']:.1f} "
        f"standard errors (at most {agreement['mean_z_at_most']:.1f})"
    )
