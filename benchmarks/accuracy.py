"""Accuracy of learnt priors, of lifts and reconstructions, and of samplers.

Prints ``name: value`` lines. ``diffusion``: metrics of 400 draws (split Gibbs: 200, with 2D
denoisers), mean over seeds. ``exact-priors``: see ``annotation_figures.py`` and
``denoising_figures.py``; ``learnt``: ``denoising_figures.py`` and ``vae_figures.py``; ``cameras``,
``images``, ``lift``, ``mixing``: ``camera_figures.py``, ``image_figures.py``, ``lift_figures.py``,
``mixing_figures.py``.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

from annotation_figures import PARTS, salsa
from camera_figures import camera_figures
from denoising_figures import denoising_figures, learnt_figures
from image_figures import image_figures
from lift_figures import lift_figures
from mixing_figures import mixing_figures
from vae_figures import vae_figures

from probmotion import compare
from probmotion.data.pair_sets import SALSA_HELD_OUT
from probmotion.posteriors.sampling import Sampler
from probmotion.samplers import Ancestral3D, MultiViewPredictorCorrector
from probmotion.samplers.conditional import SplitGibbs
from probmotion.threads import one_thread

Figures = Iterator[tuple[str, float]]


def diffusion_figures() -> Figures:
    """Yield metrics of diffusion samplers against exact posteriors, mean over seeds."""
    with_views = {"denoiser": "2d"}
    grids: tuple[tuple[str, str, Sampler, int, int, dict[str, str]], ...] = (
        ("ancestral3d", "gait", Ancestral3D(), 400, 5, {"c2st": "c2st"}),
        ("ancestral3d", "cmu-monocular", Ancestral3D(), 400, 3, {"c2st": "c2st"}),
        (
            "mvpc", "gait", MultiViewPredictorCorrector(), 400, 5,
            {"swd": "swd_ratio", "variance": "variance_ratio", "c2st": "c2st"},
        ),
        (
            "mvpc", "cmu", MultiViewPredictorCorrector(), 400, 3,
            {
                "swd": "swd_ratio", "variance": "variance_ratio",
                "off_manifold": "off_manifold_ratio", "c2st": "c2st",
            },
        ),
        (
            "split_gibbs", "gait-monocular", SplitGibbs(**with_views), 200, 2,
            {"mean_error": "mean_error_sd", "variance": "variance_ratio", "c2st": "c2st"},
        ),
        (
            "split_gibbs", "cmu-monocular", SplitGibbs(**with_views), 200, 1,
            {"mean_error": "mean_error_sd", "variance": "variance_ratio"},
        ),
    )  # fmt: skip
    for label, problem, sampler, draws, n_seeds, names in grids:
        options = {"draws": draws, "seeds": n_seeds, "workers": 2, "progress": False}
        table = compare(problem, {label: sampler}, **options).table()  # type: ignore[arg-type]
        means = table.groupby("metric")["value"].mean()
        for short, metric in names.items():
            yield f"{label}_{problem.replace('-', '_')}_{short}", means[metric]


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("exact-priors", help="Priors learnt from clips and from 2D.")
    command.add_argument("--data", required=True, help="Folder with the real motions.")
    command.add_argument(
        "--parts",
        nargs="*",
        choices=["denoising", *PARTS],
        default=["denoising", "lifting", "completion"],
    )
    command.add_argument("--held-out", nargs="*", default=SALSA_HELD_OUT, help="Salsa clips.")
    commands.add_parser("diffusion", help="Diffusion samplers against exact posteriors.")
    command = commands.add_parser("cameras", help="Lifts of one and of several calibrated cameras.")
    command.add_argument("--data", required=True, help="Folder with the real motions.")
    command = commands.add_parser("images", help="Reconstructions of made images.")
    command.add_argument("--category", choices=["quadruped", "person"], default="quadruped")
    command.add_argument("--data", type=Path, help="Folder with real motions; else synthetic ones.")
    command.add_argument("--part", choices=["validation", "test"], default="test")
    command.add_argument(
        "--images", type=int, default=200, help="Number of images; 200 by default."
    )
    command.add_argument("--clips", type=int, default=0, help="Number of clips; 0 by default.")
    command.add_argument("--ablations", action="store_true", help="Also without parts of it.")
    command = commands.add_parser("lift", help="Lifts of made videos of held-out clips.")
    command.add_argument("--data", required=True, help="Folder with the real motions.")
    command.add_argument(
        "--lifter",
        type=Path,
        help="Folder of the unsupervised lifter, which is trained there (minutes) if it is absent; "
        "by default, lifts are not compared with it.",
    )
    command = commands.add_parser("learnt", help="Learnt priors against the spectral prior.")
    command.add_argument("--data", required=True, help="Folder with the real motions.")
    commands.add_parser("mixing", help="Samplers of many modes within budgets.")
    options = parser.parse_args()
    figures: Figures
    if options.command == "images":
        rest = (options.part, options.images, options.clips, options.ablations)
        figures = image_figures(options.category, options.data, *rest)
    elif options.command == "lift":
        figures = lift_figures(Path(options.data), options.lifter)
    elif options.command == "cameras":
        figures = camera_figures(Path(options.data))
    elif options.command == "learnt":
        folder = Path(options.data)
        figures = itertools.chain(learnt_figures(folder), vae_figures(folder))
    elif options.command in ("diffusion", "mixing"):
        figures = diffusion_figures() if options.command == "diffusion" else mixing_figures()
    else:
        pairs = salsa(options.data, tuple(options.held_out))
        figures = itertools.chain.from_iterable(
            denoising_figures(Path(options.data)) if part == "denoising" else PARTS[part](pairs)
            for part in options.parts
        )
    # Rounding can lead to other modes of images.
    with one_thread() if options.command == "images" else nullcontext():
        for name, value in figures:
            print(f"{name}: {value:.4g}", flush=True)


if __name__ == "__main__":
    main()
