"""Learning of a category from images: poses by the encoder, then the surface, in turn."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.files import forget_killed, locked_folder, writable_folder
from probmotion.models.images.category import Category
from probmotion.models.images.category_training import feature_channels, learn_surface
from probmotion.models.images.encoder import EncoderNetwork
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.posteriors.sampling import progress_bar
from probmotion.reconstruction.inference import encoded
from probmotion.reconstruction.refinement import refine
from probmotion.threads import one_thread
from probmotion.validation import check_count

__all__ = ["CATEGORY", "check_rounds", "learn_category", "rounds_done"]

CATEGORY = "category.npz"
"""File name of the learnt category in its folder."""

_KEPT = 2  # hypotheses of an image that are refined to the end


def learn_category(
    category: Category,
    network: EncoderNetwork,
    images: Sequence[ImageObservation],
    out: str | Path,
    *,
    rounds: int,
    progress: bool = True,
) -> Category:
    """Learn a category in rounds; repeat the call to resume after the last finished round.

    Each round refines the encoder's hypotheses of each image to posterior modes, and then learns
    surface, colours and features from the poses of the highest modes (:func:`learn_surface`).

    Parameters
    ----------
    category : Category
        Start category.
    network : EncoderNetwork
        Its encoder; also starts later rounds.
    images : sequence of ImageObservation
        Observations of one image each, all of them with features or none.
    out : str or Path
        Folder for ``category.npz``, written after each round; created if missing. The category is
        named after it.
    rounds : int
        Number of rounds in all.
    progress : bool
        Whether to show progress bars.

    Raises
    ------
    ValueError
        As :func:`check_rounds`, or if another process writes to ``out``.
    OSError
        If ``out`` cannot be written to.
    KeyboardInterrupt
        On Ctrl-C; finished rounds remain.
    """
    check_rounds(category, images, Path(out), rounds)
    folder = writable_folder(Path(out))
    record = _record(category, images)
    with locked_folder("out", folder):
        forget_killed(folder)
        learnt, done = category, rounds_done(folder)
        # The file has single precision; rounds start from it so that resumption is exact.
        if done:
            learnt = Category.load(folder / CATEGORY)
        for number in range(done + 1, rounds + 1):
            try:
                # Rounding can lead to other modes of a pose.
                with one_thread():
                    theta = _poses(learnt, network, images, f"poses, round {number}", progress)
                    learnt = learn_surface(learnt, images, theta, progress=progress)
            except KeyboardInterrupt as error:
                raise KeyboardInterrupt(
                    f"stopped in round {number} of {rounds}; finished rounds are saved in "
                    f"{folder}; run the same command to resume"
                ) from error
            named = replace(learnt, name=folder.resolve().name, card=record | {"rounds": number})
            named.save(folder / CATEGORY)
            learnt = Category.load(folder / CATEGORY)
    return learnt


def check_rounds(
    category: Category, images: Sequence[ImageObservation], out: Path, rounds: int
) -> None:
    """Raise ``ValueError`` if a folder has more rounds, or rounds of others than these.

    Also if only some images have features, or the category has others.
    """
    check_count("rounds", rounds)
    if feature_channels(images) and category.features.shape[1]:
        category.check_features(images[0].features)
    done = rounds_done(out)
    if not done:
        return
    if rounds < done:
        raise ValueError(
            f"rounds must be at least {done} to resume {out}, got {rounds}; use another folder"
        )
    saved = Category.load(out / CATEGORY).card
    for name, value in _record(category, images).items():
        if saved.get(name) != value:
            raise ValueError(f"{name} must be the same to resume {out}; use another folder")


def rounds_done(out: Path) -> int:
    """Return the number of finished rounds in a folder.

    Raises ``ValueError`` if its category is damaged or was not learnt.
    """
    path = out / CATEGORY
    if not path.exists():
        return 0
    rounds = Category.load(path).card.get("rounds")
    if not isinstance(rounds, int):
        raise ValueError(
            f"out must not have the {CATEGORY} of another command, got {out}; use another folder"
        )
    return rounds


def _record(category: Category, images: Sequence[ImageObservation]) -> dict[str, str]:
    """Return checksums of what a run starts from, by the option's name."""
    content = hashlib.sha256()
    for image in images:
        for array in (image.mask, image.rgb, image.features, image.tangent):
            content.update(b"" if array is None else np.asarray(array, dtype="<f4").tobytes())
    return {"category": category.digest, "clips": content.hexdigest()}


def _poses(
    category: Category,
    network: EncoderNetwork,
    images: Sequence[ImageObservation],
    label: str,
    progress: bool,
) -> np.ndarray:
    """Return θ (N, dim) of the best mode of each image.

    Features are not used before they are learnt.
    """
    found = []
    with progress_bar(len(images), label, progress) as bar:
        for image in images:
            if not category.features.shape[1]:
                image = replace(image, features=None)
            prior = SurfacePrior(category, image.tangent)
            likely, _ = encoded(network, prior, image, np.random.default_rng(0), 0)
            found.append(refine(prior, image, likely, keep=_KEPT)[0].theta)
            bar.update(1)
    return np.stack(found)
