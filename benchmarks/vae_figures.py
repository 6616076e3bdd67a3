"""Speeds, calibration and joint errors of the motion VAEs, for ``accuracy.py learnt``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from scipy.stats import kstest

from probmotion import seeds
from probmotion.data.projections import Filming, centre_motion
from probmotion.data.synthetic.animals import VARIED_TRUNKS, animal_clips
from probmotion.data.synthetic.walks import walk_clips
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.metrics.filming import film_motions
from probmotion.metrics.motion_chamfer import motion_chamfer_distance
from probmotion.models.latent.code_mixture import CodeMixture
from probmotion.models.vae.losses import best_hypothesis, predicted_hypotheses, project_to_image
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.view_hypotheses import evaluate_hypotheses
from probmotion.motion.distances import windows
from probmotion.motion.motion import Motion

NOISE = 0.01  # of keypoints of real motion, metres at the subject; as in training
DRAWS, REPEATS = 280, 5  # of the motion chamfer distance
SEQUENCES = 200  # of real motion, whose codes are drawn
FREE = 0.03  # deviation of log bone lengths and of rotations (radians) given the motion in 3D
DETERMINED = 0.8  # mean variance below which keypoints determine a dimension of the codes
TO_Y_UP = np.array([1.0, -1.0, -1.0])


def vae_figures(folder: Path) -> Iterator[tuple[str, float]]:
    """Yield the figures of ``walk-vae`` (people) and ``animal-vae``.

    ``standard_normal``: with codes from N(0, I) in place of the mixture. Speed ratio: of 1000 draws
    to the test clips; slow: slower than 99 % of their seconds. MCD: motion chamfer distance between
    views of ``DRAWS`` draws and of test clips, cm², mean and standard deviation over ``REPEATS``
    seeds. Coverage: of 90 % intervals of the encoder, seen by one camera; ``simulated``: of codes
    of draws, with keypoint errors as large as the decoder's on training tracks; otherwise of the
    codes of test clips, drawn given the true motion in 3D; ``determined``: in dimensions with a
    mean variance below ``DETERMINED``. Rank distance: largest difference between the distribution
    function of the ranks of simulated codes and the uniform one.
    """
    for name, label, clips in (
        ("walk-vae", "people", walk_clips(folder)["test"]),
        ("animal-vae", "animals", animal_clips(folder, trunks=VARIED_TRUNKS)["test"]),
    ):
        prior = MotionVAE.load(name)
        real = real_windows(prior, clips)
        plain = MotionVAE.load(name, codes=CodeMixture.standard(prior.settings.latent))
        yield from draw_figures(prior, real, label)
        yield from draw_figures(plain, real, f"standard_normal_{label}")
        errors, _ = simulated_errors(prior, 2000)
        yield f"vae_coverage_90_simulated_{label}", coverage(errors)
        yield f"vae_rank_distance_{label}", float(kstest(errors.ravel(), "norm").statistic)
        rng = seeds.generator(0, "real")
        errors, deviations = real_errors(prior, real[rng.integers(0, len(real), SEQUENCES)], rng)
        yield f"vae_coverage_90_{label}", coverage(errors)
        if label == "people":  # of animals, keypoints determine nearly all
            determined = (deviations**2).mean(axis=0) < DETERMINED
            yield "vae_coverage_90_determined_people", coverage(errors[:, determined])
    dog = [clip for clip in clips if clip.name.startswith("dog3d")]
    accuracy = evaluate_hypotheses(prior.model.pose, prior.settings, prior.body, dog, fps=prior.fps)
    yield "dog_mm", 1000 * accuracy.error
    errors, _ = real_errors(prior, real_windows(prior, dog), seeds.generator(0, "dog"))
    yield "vae_coverage_90_dog", coverage(errors)


def draw_figures(prior: MotionVAE, real: np.ndarray, label: str) -> Iterator[tuple[str, float]]:
    """Yield speed and motion chamfer distance of draws relative to real motion."""
    speeds, real_speeds = map(speed, (prior.sample(seeds.generator(0, "draws"), 1000), real))
    yield f"vae_speed_ratio_{label}", speeds.mean() / real_speeds.mean()
    yield f"vae_slow_{label}", float((speeds < np.quantile(real_speeds, 0.01)).mean())
    distances = [chamfer(prior, real, seed) for seed in range(REPEATS)]
    yield f"vae_mcd_{label}", float(np.mean(distances))
    yield f"vae_mcd_{label}_standard_deviation", float(np.std(distances, ddof=1))


def real_windows(prior: MotionVAE, clips: list[Motion]) -> np.ndarray:
    """Return the root-centred windows of clips, (N, L, J, 3), metres."""
    motions = [centre_motion(clip.retarget(prior.skeleton).resample(prior.fps)) for clip in clips]
    return np.concatenate([windows(motion.positions, prior.frames) for motion in motions])


def speed(motions: np.ndarray) -> np.ndarray:
    """Return the mean speed of joints of each motion, metres per frame."""
    return np.linalg.norm(np.diff(motions, axis=1), axis=-1).mean(axis=(1, 2))


def chamfer(prior: MotionVAE, real: np.ndarray, seed: int) -> float:
    """Return the motion chamfer distance between views of draws and of real motion, cm²."""
    rng, root = seeds.generator(seed, "views"), prior.skeleton.roots[0]
    motions = (
        prior.sample(seeds.generator(seed, "draws"), DRAWS),
        real[rng.integers(0, len(real), DRAWS)],
    )
    drawn, held_out = (film_motions(some, rng, root=root) for some in motions)
    return 1e4 * motion_chamfer_distance(drawn, held_out).mean


def coverage(errors: np.ndarray) -> float:
    """Return the share of codes in the 90 % intervals of the encoder."""
    return float((np.abs(errors) < 1.645).mean())


def errors_of(
    prior: MotionVAE, z: np.ndarray, keypoints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the encoder in its standard deviations, and these, (n, Z) each."""
    seen = torch.ones(keypoints.shape[:-1])
    rest = torch.as_tensor(prior.body.rest_positions, dtype=torch.float32)
    points = torch.as_tensor(keypoints, dtype=torch.float32)
    with torch.no_grad():
        mean, log_variance = prior.model.vae.encode(points, seen, rest)
    deviation = np.exp(0.5 * log_variance.numpy())
    return (z - mean.numpy()) / deviation, deviation


def centred(prior: MotionVAE, keypoints: np.ndarray) -> np.ndarray:
    """Return keypoints relative to the root in every frame."""
    return keypoints - keypoints[..., [prior.skeleton.roots[0]], :]


def filmed(
    prior: MotionVAE, z: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return decoded motions relative to random cameras, (n, L, J, 3), and their keypoints."""
    positions = prior.row_by_row(z) - prior.rigid.translations[:, None]
    rotation = TO_Y_UP[:, None] * Filming().cameras(rng, len(z)).rotation
    posed = np.einsum("nij,nlkj->nlki", rotation, positions)
    return posed, project_to_image(torch.as_tensor(posed), Filming().distance).numpy()


def simulated_errors(prior: MotionVAE, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return :func:`errors_of` codes of draws that stand upright before random cameras."""
    rng = seeds.generator(0, "simulated")
    z = prior.initial(rng, n)
    _, image = filmed(prior, z, rng)
    image = image + prior.card["deviation"] * rng.standard_normal(image.shape)
    return errors_of(prior, z, centred(prior, image))


def real_errors(
    prior: MotionVAE, motions: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return :func:`errors_of` codes of real motions, (n, L, J, 3)."""
    cameras = Filming().cameras(rng, len(motions))
    clean = np.stack([cameras.view(i).project(x)[0] for i, x in enumerate(motions)])
    noisy = clean + NOISE * rng.standard_normal(clean.shape)
    truth = np.einsum("nij,nlkj->nlki", cameras.rotation, motions) * TO_Y_UP
    z = codes_of(prior, truth, centred(prior, clean), rng).numpy()
    return errors_of(prior, z, centred(prior, noisy))


def codes_of(
    prior: MotionVAE, truth: np.ndarray, keypoints: np.ndarray, rng: np.random.Generator
) -> torch.Tensor:
    """Draw the codes of motions (n, L, J, 3) relative to the camera, given in 3D.

    Joints differ from decoded motion by errors as large as the decoder's on training tracks. The
    body's rotations in every frame and its bone lengths are free as well; they start at the
    estimates of the pose network. Codes of the highest density would not do: they are closer to the
    mean than codes are, and in most intervals.
    """
    points = keypoints.astype(np.float32)
    given = prior.model.pose, prior.settings, prior.body, points, np.ones(points.shape[:-1])
    pose = best_hypothesis(*predicted_hypotheses(*given, Filming().distance))
    rest = torch.as_tensor(prior.body.rest_positions, dtype=torch.float32)
    with torch.no_grad():
        start, _ = prior.model.vae.encode(
            torch.as_tensor(points), torch.ones(points.shape[:-1]), rest
        )
    n, frames = pose.rotation.shape[:2]
    sizes = start.shape[1], pose.log_lengths.shape[1], 3 * frames
    target, origin = torch.as_tensor(truth, dtype=torch.float32), torch.zeros((n, frames, 3))

    def energy(theta: torch.Tensor) -> torch.Tensor:
        z, lengths, turn = theta.split(sizes, dim=1)
        rotation = pose.rotation @ vector_to_matrix(turn.reshape(n, frames, 3))
        fixed = rotation, origin, pose.log_lengths + lengths
        posed = prior.body.positions(prior.model.vae.decode(z), *fixed)
        error = ((posed - target) ** 2).sum(dim=(1, 2, 3)) / (2 * prior.card["deviation"] ** 2)
        return error - prior.log_density(z)

    theta = torch.cat([start, torch.zeros((n, sum(sizes[1:])))], dim=1).requires_grad_()
    steps = 300
    optimiser = torch.optim.Adam([theta], lr=0.03)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        optimiser.zero_grad()
        energy(theta).sum().backward()
        optimiser.step()
        schedule.step()
    scale = torch.cat([torch.ones(sizes[0]), torch.full((sum(sizes[1:]),), FREE)])
    start = theta.detach() / scale
    return hamiltonian_draws(lambda x: energy(scale * x), start, rng)[:, : sizes[0]]


def hamiltonian_draws(
    energy: Callable[[torch.Tensor], torch.Tensor],
    start: torch.Tensor,
    rng: np.random.Generator,
    *,
    trajectories: int = 30,
    leaps: int = 16,
) -> torch.Tensor:
    """Return one draw of exp(−energy) for each row, (n, D), by Hamiltonian Monte Carlo.

    Rows are independent; the step of each is adapted during the first half to accept 80 %.
    """

    def with_gradient(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = x.detach().requires_grad_()
        value = energy(x)
        return value.detach(), torch.autograd.grad(value.sum(), x)[0]

    x = start
    value, slope = with_gradient(x)
    step = torch.full((len(x), 1), 0.1)
    for trajectory in range(trajectories):
        momentum = torch.as_tensor(rng.standard_normal(x.shape), dtype=x.dtype)
        before, there, force = value + 0.5 * (momentum**2).sum(dim=1), x, slope
        length = step * rng.uniform(0.8, 1.2)
        for _ in range(leaps):
            momentum = momentum - 0.5 * length * force
            there = there + length * momentum
            potential, force = with_gradient(there)
            momentum = momentum - 0.5 * length * force
        rise = potential + 0.5 * (momentum**2).sum(dim=1) - before
        accepted = torch.exp(-rise).nan_to_num(0.0).clamp(max=1.0)
        kept = torch.as_tensor(rng.random(len(x))) < accepted
        x = torch.where(kept[:, None], there, x)
        slope = torch.where(kept[:, None], force, slope)
        value = torch.where(kept, potential, value)
        if trajectory < trajectories // 2:
            step = step * torch.exp(0.3 * (accepted[:, None] - 0.8))
    return x
