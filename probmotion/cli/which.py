"""The command ``probmotion which``: the sampler to take for a problem, by what was measured.

It is a dataclass whose fields are its options, as in :mod:`probmotion.cli`.
"""

from __future__ import annotations

from dataclasses import dataclass

from tyro.conf import Positional

__all__ = ["Which"]


@dataclass(frozen=True)
class Which:
    """Say which sampler to take for a problem, how wrong it is, and what is wrong with the others.

    The figures were measured once, with a small budget, and come with the package; of other
    problems, numbers and budgets, probmotion compare finds out.
    """

    problems: Positional[tuple[str, ...]] = ()
    """Names of problems (see probmotion list); all that were measured by default."""

    def run(self) -> None:
        """Print the advice."""
        from probmotion.comparison import advise, measured

        print("\n\n".join(str(advise(name)) for name in self.problems or measured().problems))
