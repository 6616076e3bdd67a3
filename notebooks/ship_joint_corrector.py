"""Train joint-corrector and write its weights and model card.

    python notebooks/ship_joint_corrector.py --data ../shared/data --pairs pairs

Training needs posteriors under priors that have not seen the clip. The training clips are therefore
split into four parts; the posteriors of a part's windows are those under a spectral prior fitted to
the other parts. They are stored in ``--pairs``, which an interrupted run continues.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
import zlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.fft import dct
from scipy.interpolate import CubicSpline

from probmotion import seeds
from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.person_clips import action_clips
from probmotion.extras import torch
from probmotion.files import read_arrays, written_whole
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.dvae.joint_corrector import (
    CorrectorNetwork,
    CorrectorSettings,
    JointCorrector,
)
from probmotion.models.dvae.joint_noise import JointNoise
from probmotion.models.mixture.denoising import denoise_joints
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.mixture.spectrum import bands
from probmotion.models.training.checkpoints import WEIGHTS
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

NAME = "joint-corrector"
FOLDS = 4
COMPONENTS = {"studio": 60, "actions": 20}  # of the spectral priors, as of cmu-motion
NOISE = (0.008, 0.08)  # metres
COMPLETE = 0.35  # fraction of windows without gaps
TEMPO = 1.2
JITTER = 0.15  # of the heading in training, radians
CHUNK = 60  # windows per file
RIDGE = 300.0
Clips = dict[str, dict[str, list[Motion]]]
Pairs = dict[str, np.ndarray]


def main() -> None:
    """Make pairs of posteriors and truth, train, and write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="Folder of the recordings.")
    parser.add_argument("--pairs", type=Path, required=True, help="Folder of the posteriors.")
    parser.add_argument("--windows", type=int, default=84_000, help="Number of training windows.")
    parser.add_argument("--steps", type=int, default=1900, help="Number of training steps.")
    parser.add_argument("--workers", type=int, default=4, help="Number of processes.")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="Folder of the weights.")
    options = parser.parse_args()
    clips = {"studio": denoising_clips(options.data), "actions": action_clips(options.data)}
    options.pairs.mkdir(parents=True, exist_ok=True)
    numbers = range(-(-options.windows // CHUNK))
    with ProcessPoolExecutor(options.workers) as pool:
        jobs = [pool.submit(make_pairs, clips, number, options.pairs) for number in numbers]
        files = [job.result() for job in jobs]
    held_out = make_pairs(clips, None, options.pairs)
    pairs, validation = stacked(files), stacked([held_out])
    start = time.perf_counter()
    network, history = trained(pairs, validation, options.steps)
    fit_energy(network, pairs)
    record = {"data": {part: names(clips, part) for part in ("train", "validation")}}
    card = {"network": record, "history": history, "seconds": time.perf_counter() - start}
    first = clips["studio"]["train"][0]
    corrector = JointCorrector(network.cpu(), CorrectorSettings(), first.skeleton, first.fps, card)
    corrector.save(options.out / f"{NAME}.safetensors", half=True)
    print(f"wrote {options.out / NAME}.safetensors; the card is written by hand")


def names(clips: Clips, part: str) -> list[str]:
    """Return the names of the clips of a part, sorted."""
    return sorted(clip.name for source in clips.values() for clip in source[part])


def fold_of(name: str) -> int:
    """Return the part of a clip; segments of a clip are in the same part."""
    return zlib.crc32(name.split("-")[0].encode()) % FOLDS


def mirrored(motion: Motion) -> Motion:
    """Return the motion with left and right exchanged."""
    order = list(motion.skeleton.mirrored_order)
    return replace(motion, positions=motion.positions[:, order] * [-1.0, 1.0, 1.0])


def fitted(clips: Clips, left_out: int | None) -> SpectralMixtureMotion:
    """Return the spectral prior of the training clips that are not in a part."""
    priors = []
    for source, count in COMPONENTS.items():
        used = [clip for clip in clips[source]["train"] if fold_of(clip.name) != left_out]
        both = [*used, *map(mirrored, used)]
        priors.append(SpectralMixtureMotion.fit(both, components=count, progress=False))
    arrays = ("poses", "velocities", "directions", "variances")
    together = {name: np.concatenate([getattr(p, name) for p in priors]) for name in arrays}
    weights = np.concatenate([prior.weights for prior in priors]) / len(priors)
    return replace(priors[0], weights=weights, **together)


_PRIORS: dict[int | None, SpectralMixtureMotion] = {}  # of this process


def make_pairs(clips: Clips, number: int | None, folder: Path) -> Path:
    """Write posteriors of random windows and the true motion; ``None``: of the validation clips."""
    path = folder / f"{'validation' if number is None else number}.npz"
    if path.exists():
        return path
    fold = None if number is None else number % FOLDS
    if fold not in _PRIORS:
        _PRIORS[fold] = fitted(clips, fold)
    prior = _PRIORS[fold]
    rng = seeds.generator(0, "pairs", str(number))
    if number is None:
        windows = cut([c for source in clips.values() for c in source["validation"]], prior.frames)
    else:
        own = [c for source in clips.values() for c in source["train"] if fold_of(c.name) == fold]
        tempo = math.exp(rng.uniform(-1, 1) * math.log(TEMPO))
        windows = cut([*own, *map(mirrored, own)], prior.frames, tempo, int(rng.integers(0, 30)))
        windows = windows[rng.permutation(len(windows))[:CHUNK]]
    rows = [posterior(window, prior, rng) for window in windows]
    columns = map(np.float32, zip(*rows, strict=True))
    arrays = dict(zip(("mean", "sd", "truth"), columns, strict=True))
    with written_whole(path) as unfinished, unfinished.open("wb") as file:
        np.savez(file, **arrays)
    return path


def cut(clips: Sequence[Motion], frames: int, tempo: float = 1.0, offset: int = 0) -> np.ndarray:
    """Return windows of clips at a tempo, every second from a frame on, (n, L, J, 3)."""
    windows = []
    for clip in clips:
        times = np.arange(int((clip.frames - 1) / tempo) + 1) * tempo
        positions = CubicSpline(np.arange(clip.frames), clip.positions)(times)
        last = len(positions) - frames
        starts = range(min(offset, max(last, 0)), last + 1, 30)
        windows += [positions[start : start + frames] for start in starts]
    return np.stack(windows)


def posterior(
    window: np.ndarray, prior: SpectralMixtureMotion, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return posterior mean, standard deviation and truth of a window with noise and gaps."""
    truth = window - window.mean(axis=(0, 1)) * [1.0, 0.0, 1.0]
    noise = math.exp(rng.uniform(*np.log(NOISE)))
    gaps = JointNoise(noise, noise, outliers=0.0, hidden=float(rng.random() >= COMPLETE))
    noisy = gaps.apply(rng, truth[None], prior.skeleton)
    found = denoise_joints(
        noisy.joints[0], noisy.seen[0].astype(float), skeleton=prior.skeleton, fps=prior.fps,
        noise=noise, draws=0, progress=False, prior=prior,
    )  # fmt: skip
    return found.mean, found.sd, truth


def stacked(files: Sequence[Path]) -> Pairs:
    """Return the arrays of files, joined."""
    parts = [read_arrays(path) for path in files]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def canonical(
    network: CorrectorNetwork, pairs: Pairs, rows: np.ndarray, jitter: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return mean, standard deviation and truth of windows that face +Z, on the device."""
    device = network.place.device
    mean, sd, truth = (torch.as_tensor(pairs[key][rows], device=device) for key in pairs)
    angle = network.heading(mean) + jitter * torch.randn(len(rows), device=device)
    sd = sd.square().mean(dim=-1).sqrt()
    return turned_about_vertical(mean, angle), sd, turned_about_vertical(truth, angle)


def trained(
    pairs: Pairs, validation: Pairs, steps: int
) -> tuple[CorrectorNetwork, list[dict[str, float]]]:
    """Return the network of the smallest validation error, and its history.

    The loss is the negative log likelihood of the truth under independent Gaussians, whose
    standard deviations are the posterior's times a factor of each joint.
    """
    torch.manual_seed(0)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    size = CorrectorSettings()
    skeleton = Skeleton.preset("person14")
    network = CorrectorNetwork(size, skeleton).to(device)
    rng = seeds.generator(0, "batches")
    batch = min(512, len(pairs["mean"]))
    with torch.no_grad():
        mean, sd, _ = canonical(network, pairs, rng.integers(0, len(pairs["mean"]), 4000))
        features = network.features(mean, sd).flatten(0, 1)
        network.centre.copy_(features.mean(dim=0))
        network.spread.copy_(features.std(dim=0).clamp_min(1e-3))
    ratio = torch.nn.Linear(size.width, skeleton.n_joints, device=device)
    torch.nn.init.zeros_(ratio.weight)
    torch.nn.init.zeros_(ratio.bias)
    average, best, history = copy.deepcopy(network), copy.deepcopy(network), []
    weights = [*network.parameters(), *ratio.parameters()]
    groups = [
        {"params": [w for w in weights if w.dim() > 1], "weight_decay": 0.1},
        {"params": [w for w in weights if w.dim() <= 1], "weight_decay": 0.0},
    ]
    optimiser = torch.optim.AdamW(groups, betas=(0.9, 0.98))
    rate = partial(rate_at, steps=steps)
    for step in range(1, steps + 1):
        for group in optimiser.param_groups:
            group["lr"] = rate(step)
        network.train()
        rows = rng.integers(0, len(pairs["mean"]), batch)
        mean, sd, truth = canonical(network, pairs, rows, JITTER)
        found = network(mean, sd)
        error = truth - mean - found.mean
        log_sd = sd.log() + ratio(found.features).clamp(-3, 3)
        loss = (0.5 * error.square().sum(dim=-1) * torch.exp(-2 * log_sd) + 3 * log_sd).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimiser.step()
        decay = min(0.999, (1 + step) / (10 + step))
        with torch.no_grad():
            torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), 1 - decay)
        if step % 100 == 0 or step == steps:
            error_ratio = validation_error(average, validation)
            history.append({"step": step, "loss": loss.item(), "validation": error_ratio})
            print(history[-1], flush=True)
            if error_ratio == min(row["validation"] for row in history):
                best.load_state_dict(average.state_dict())
    return best.eval().requires_grad_(False), history


def rate_at(step: int, steps: int) -> float:
    """Return the learning rate: a linear rise, then a half cosine."""
    return 1e-3 * min(1.0, step / 200) * max(0.5 * (1 + math.cos(math.pi * step / steps)), 0.01)


def validation_error(network: CorrectorNetwork, pairs: Pairs) -> float:
    """Return the mean error of corrected validation windows over that of the posterior means."""
    network.eval()
    with torch.no_grad():
        mean, sd, truth = canonical(network, pairs, np.arange(len(pairs["mean"])))
        corrected = mean + network(mean, sd).mean
    new, old = ((part - truth).norm(dim=-1).mean() for part in (corrected, mean))
    return float(new / old)


def fit_energy(network: CorrectorNetwork, pairs: Pairs) -> None:
    """Fit the linear readout of the energies of the remaining errors, by maximum likelihood."""
    rows = np.arange(min(len(pairs["mean"]), 20_000))
    features, energies = [], []
    for part in np.array_split(rows, -(-len(rows) // 256)):
        mean, sd, truth = canonical(network, pairs, part)
        found = network(mean, sd)
        features.append(found.features.mean(dim=1).cpu())
        error = (truth - mean - found.mean).cpu().numpy()
        power = (dct(error, axis=1, norm="ortho") ** 2).mean(axis=-1)
        energies.append(np.stack([power[:, b].mean(axis=1) for b in high_bands(network)], axis=1))
    given, observed = torch.cat(features), torch.as_tensor(np.concatenate(energies))
    middle, spread = given.mean(dim=0), given.std(dim=0)
    standard = (given - middle) / spread
    base = observed.mean(dim=0).log().requires_grad_()
    weight = torch.zeros((len(base), given.shape[1]), requires_grad=True)
    fit = torch.optim.LBFGS([weight, base], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        fit.zero_grad()
        log_energy = base + (standard @ weight.T)[:, :, None]
        likelihood = 0.5 * (observed * torch.exp(-log_energy) + log_energy).mean()
        total: torch.Tensor = likelihood + RIDGE * weight.square().sum() / observed[:, 0].numel()
        total.backward()
        return total

    fit.step(loss)
    with torch.no_grad():
        network.energy.weight.copy_(weight / spread)
        network.energy.bias.copy_(-(weight @ (middle / spread)))
        network.log_energy.copy_(base)


def high_bands(network: CorrectorNetwork) -> list[np.ndarray]:
    """Return the frequencies of each band of high frequencies."""
    band = bands(len(network.place))
    first = band[-1] + 1 - len(network.log_energy)
    return [np.flatnonzero(band == b) for b in range(first, band[-1] + 1)]


if __name__ == "__main__":
    main()
