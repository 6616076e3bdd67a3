"""Small valid files of every kind that this package writes for itself, with their readers."""

import json
from functools import partial
from unittest import mock

import numpy as np
from made_reports import WALK, filmed_problem, walk_prior

from probmotion import MotionDraws, MotionPosterior, open_draws
from probmotion.calibration.error_result import StoredValues
from probmotion.comparison.grid import Comparison
from probmotion.comparison.results.failures import Failure
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.run_results import RunResult
from probmotion.comparison.results.stored_problems import read_stored, store_problem
from probmotion.comparison.run.grid_tasks import Pilot
from probmotion.files import LOCK
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.mixture.spectrum import principal_directions
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.training.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
from probmotion.models.unseen_depth.pose_depth import INPUTS, PoseDepth
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors import streams
from probmotion.posteriors.reference import StoredReference
from probmotion.samplers.mcmc.metropolis import MetropolisHastings
from probmotion.samplers.mcmc.stored_chain import StoredChain

LEG = Skeleton(["hip", "knee"], [-1, 0])
FINGERPRINT = "0" * 16
STATISTICS = {
    "digest": "ab", "n": 40.0, "m": 400.0, "mean": [0.1, 0.2], "spread": [[1.0, 0.1], [0.1, 1.0]],
    "ratios": {"variance": [0.1, 2.0], "leading variance": [0.0, 2.0]},
    "modes": {"walk": [0.4, 0.5], "run": [0.6, 0.5]}, "modes_spread": [[0.3, -0.3], [-0.3, 0.3]],
    "classifier": [0.5, 0.1], "distance": [1.1, 0.4], "rhat": 1.0, "rhat_by_chance": 1.1,
}  # fmt: skip


class Named:
    name = "made"


STREAMED = {}
"""Draws that :func:`write_stream` wrote."""


def small_draws():
    """Return two chains of three draws of a walk."""
    drawn = WALK.positions + 0.01 * np.random.default_rng(0).normal(
        size=(2, 3, *WALK.positions.shape)
    )
    return MotionDraws.of(
        MotionPosterior(walk_prior()), Named(), drawn, seed=2**40, seconds=1.0,
        statistics={"energy": np.ones((2, 3))}, counts={"density": 7}, state={"step": np.ones(2)},
    )  # fmt: skip


def write_comparison(folder):
    """Write a grid of one problem with a finished and a failed run."""
    plan = Plan(
        {"filmed": "a walk"}, {"good": {"step": "2"}, "bad": {}}, draws=6, chains=2, seeds=1,
        budget="1 second per run", untuned=("bad",), versions={"numpy": "2"}, date="2025-01-01",
        fingerprints={"problem": {"filmed": "a"}, "sampler": {"good": "b", "bad": "c"}},
        machine="one", command="probmotion compare",
    )  # fmt: skip
    plan.save(folder)
    budget = {"allowed": "1 second", "settings": {"step": 2}, "used": 1.0}
    metrics = {"swd_ratio": 1.0, "seconds": 1.0, "rhat": None}
    failure = Failure("nan", "NaN or infinite", unsupported=False)
    for run in (
        RunResult("filmed", "good", 0, FINGERPRINT, metrics, None, budget, 7, STATISTICS),
        RunResult("filmed", "bad", 0, FINGERPRINT, {}, failure),
    ):
        home = plan.run_folder(folder, run.problem, run.sampler, run.seed)
        home.mkdir(parents=True)
        stored = vars(run) | {"failure": run.failure and vars(run.failure)}
        (home / "run.json").write_text(json.dumps(stored))
    small_draws().save(folder / "runs/filmed/good/0/draws.nc")
    store_problem(filmed_problem(3), folder / "problems/filmed", draws=2)


def write_reference(folder):
    certificate = {
        "problem": "toy", "draws": 6, "exact": False, "sampler": "nuts", "settings": {"a": 1},
        "rhat": 1.001, "ess_bulk": 400.0, "agreement": [1.0], "seed": 0, "fingerprint": [1.0, -2.5],
    }  # fmt: skip
    positions = np.random.default_rng(0).normal(size=(6, 3, 2, 3))
    StoredReference(positions, certificate).save(folder / "toy")


def write_annotations(folder):
    keypoints = np.random.default_rng(0).normal(size=(3, 2, 2))
    neighbours = np.full((3, 2, 2, 2), np.nan)
    Annotations(
        keypoints, np.ones((3, 2), bool), LEG, neighbours, 30.0, views=np.zeros((3, 2)),
        sources=["a", "b", "c"], dropped={"blurred": 2},
    ).save(folder / "a.npz")  # fmt: skip


def write_prior(folder):
    covariances = 0.1 * np.stack([np.eye(6)] * 2)
    means = np.random.default_rng(0).normal(size=(2, 2, 3))
    means -= means.mean(axis=1, keepdims=True)
    views = np.array([[0.1, 0.2], [1.0, 0.0]])
    AnnotationPrior(np.array([0.4, 0.6]), means, covariances, 0.03, views).save(folder / "p.npz")


def write_spectra(folder):
    poses = np.random.default_rng(0).normal(size=(2, 2, 3))
    band = np.array([0, 1, 2])
    directions, variances = principal_directions(np.stack([0.1 * np.eye(6)] * 3), band)
    SpectralMixtureMotion(
        LEG, 30.0, poses - poses.mean(axis=1, keepdims=True), np.zeros((2, 2)),
        np.stack([directions] * 2), band, np.stack([variances] * 2), np.array([0.4, 0.6]),
        azimuths=2, card={"command": "x"},
    ).save(folder / "s.npz")  # fmt: skip


def read_spectra(folder):
    prior = SpectralMixtureMotion.load(folder / "s.npz")
    assert np.isfinite(prior.motion(np.ones((1, prior.dim)))).all()


def write_depths(folder):
    layers = [(0.1 * np.ones((o, i)), np.zeros(o)) for i, o in ((INPUTS, 4), (4, 4), (4, 26))]
    PoseDepth(layers, {"command": "x"}).save(folder / "d.npz")


def write_category(folder):

    from tests.models.images.bodies import small_quadruped

    small_quadruped().save(folder / "c.npz")


def read_category(folder):
    """Load a category and render a body of it."""
    import torch

    from probmotion.models.images.category import Category
    from probmotion.models.images.surface_prior import SurfacePrior

    prior = SurfacePrior(Category.load(folder / "c.npz"), np.array([0.15]))
    return prior.render(torch.zeros(1, prior.dim), 8)


def write_images(folder):
    from PIL import Image

    body = np.zeros((24, 20), np.uint8)
    body[6:18, 4:15] = 255
    colours = np.random.default_rng(0).integers(255, size=(24, 20, 3), dtype=np.uint8)
    for ending in ("png", "jpg"):
        Image.fromarray(colours).save(folder / f"image.{ending}")
    Image.fromarray(body).save(folder / "mask.png")
    np.savez(folder / "features.npz", features=colours[:6, :5].astype(np.float32))


def read_images(folder):
    from probmotion.models.images.observation import ImageObservation

    read = partial(ImageObservation.read, mask=folder / "mask.png", size=16)
    read(folder / "image.jpg")
    return read(folder / "image.png", features=folder / "features.npz")


def write_checkpoint(folder):
    import torch

    settings = {
        "network": {
            "joint_names": ["hip", "knee"], "parents": [-1, 0], "size": {"width": 4},
            "data": {"tracks": 3, "clips": ["walk"]},
        },
        "history": [{"loss": 0.1}], "training": {"steps": 9, "batch": 2}, "step": 3, "seconds": 1.0,
    }  # fmt: skip
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(2, dtype=torch.int64)}
    save_checkpoint(folder / "model.safetensors", Checkpoint("toy", settings, tensors))


def write_chain(folder):
    np.savez(folder / "chain.npz", state=np.ones(3), rng=np.array(["a", "b"]))


def write_values(folder):
    StoredValues(folder, "what").put("mas", 0, {"bias": 0.5})


def write_pilot(folder):
    stored = {"fingerprint": FINGERPRINT, "settings": {"steps": 3}, "failure": None}
    (folder / "pilot.json").write_text(json.dumps(stored))


def streamed(folder):
    """Write three draws of two chains to a stream with small chunks, or continue it."""
    sampler, posterior = MetropolisHastings(warmup=3, thin=1), MotionPosterior(walk_prior())
    with mock.patch.object(streams, "_BLOCK_BYTES", 1):
        return streams.stream_draws(sampler, posterior, folder, draws=3, chains=2, progress=False)


def read_stream(folder):
    """Open draws and continue their run, which is finished; other draws must not be read."""
    for draws in (open_draws(folder), streamed(folder)):
        for name, expected in STREAMED.items():
            values = draws.dataset[name].values
            np.testing.assert_array_equal(values, expected[:, : values.shape[1]])


def write_stream(folder):
    STREAMED.update(
        {name: streamed(folder).dataset[name].values for name in ("positions", "theta")}
    )
    (folder / LOCK).unlink()


def write_stored(folder):
    store_problem(filmed_problem(3), folder, draws=2)


def read_draws(folder):
    draws = MotionDraws.load(folder / "draws.nc")
    assert np.isfinite(draws.flat()).all()
    return draws.motion(0), draws.counts, draws.state, draws.seconds


def read_comparison(folder):
    comparison = Comparison.load(folder)
    return comparison.summary(), str(comparison.table())


def read_report(folder):
    comparison = Comparison.load(folder)
    return comparison.report(folder / "report.html")


def read_checkpoint(folder):
    return load_checkpoint(folder / "model.safetensors", "toy")


def read_summary(folder):
    from probmotion.cli.summaries import summarise

    return summarise(folder / "model.safetensors").text


def read_pilot(folder):
    return Pilot(
        path=folder / "pilot.json", problem="p", sampler="s", source="p", with_sampler=None,
        draws=1, chains=1, fingerprint="",
    ).result()  # fmt: skip


OWN = {
    "draws": (lambda folder: small_draws().save(folder / "draws.nc"), read_draws),
    "comparison": (write_comparison, read_comparison),
    "report": (write_comparison, read_report),
    "reference": (write_reference, lambda folder: StoredReference.load(folder / "toy")),
    "annotations": (write_annotations, lambda folder: Annotations.load(folder / "a.npz")),
    "annotation prior": (write_prior, lambda folder: AnnotationPrior.load(folder / "p.npz")),
    "spectral prior": (write_spectra, read_spectra),
    "pose depth": (write_depths, lambda folder: PoseDepth.load(folder / "d.npz")),
    "joint limits": (
        lambda folder: JointLimits.shipped().save(folder / "l.npz"),
        lambda folder: JointLimits.load(folder / "l.npz"),
    ),
    "category": (write_category, read_category),
    "images": (write_images, read_images),
    "checkpoint": (write_checkpoint, read_checkpoint),
    "summary": (write_checkpoint, read_summary),
    "chain": (write_chain, lambda folder: StoredChain(folder / "chain.npz").load()),
    "decomposition": (write_values, lambda folder: StoredValues(folder, "what")),
    "pilot": (write_pilot, read_pilot),
    "stream": (write_stream, read_stream),
    "stored problem": (write_stored, read_stored),
}
"""Functions that write into a folder and read it, by kind."""
