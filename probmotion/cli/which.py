"""The command ``probmotion which``: advice on samplers from measurements."""

from __future__ import annotations

from dataclasses import dataclass

from tyro.conf import Positional

__all__ = ["Which"]


@dataclass(frozen=True)
class Which:
    """Recommend a sampler for a problem and list its error and those of the alternatives.

    The shipped measurements come from one comparison with a small budget and, where no sampler is
    right within it, from longer runs. Use probmotion compare for other problems and budgets.
    """

    problems: Positional[tuple[str, ...]] = ()
    """Names of problems (see probmotion list); all measured problems by default."""

    def run(self) -> None:
        from probmotion.comparison import advise, measured

        print("\n\n".join(str(advise(name)) for name in self.problems or measured().problems))
