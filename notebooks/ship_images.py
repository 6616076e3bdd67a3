"""Learn the shipped categories of images, ``quadruped`` and ``person``, and write their cards.

``python notebooks/ship_images.py quadruped --data ../shared/data --out runs/quadruped-images``
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from probmotion.data.person_clips import moving_clips
from probmotion.data.synthetic import animal_clips
from probmotion.models.bodies.turn_fit import fit_turns
from probmotion.models.images.category import Category
from probmotion.models.images.encoder_training import EncoderTrainee, encoder_of
from probmotion.models.latent.turn_code import TurnCode
from probmotion.models.training.checkpoints import load_checkpoint, save_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

WEIGHTS = Path(__file__).parents[1] / "models" / "weights"
FRAMES, DIM = 10, 32
STEPS = 5000
TRAINING = TrainingSettings(
    steps=STEPS,
    batch=64,
    learning_rate=1.5e-3,
    ema=0.99,
    halve_at=(2000, 3000, 3800, 4400),
    checkpoint_every=250,
)
SILHOUETTES = TrainingSettings(
    steps=2500,
    batch=32,
    learning_rate=5e-4,
    ema=0.99,
    clip=50.0,
    halve_at=(1000, 1600, 2000, 2300),
    checkpoint_every=250,
)

CARD = """# {name}-images

A {name} in one image, for `probmotion reconstruct`: the surface of its skeleton's capsules, and an
encoder of {parameters:.1f} million weights.

- **Motions**: {windows} windows of {frames} frames at {fps:g} frames per second, of {clips};
  {dim} principal components of bone rotations, which reproduce the joints to {error:.1f} mm before
  the reduction. Draws move at {speed:.2f} times the speed of the windows.
- **Provenance**: {provenance}
- **Surface, shapes and colours**: not learnt; `Category.of_capsules`. `probmotion train images`
  learns them from clips of images.
- **Encoder**: learnt from images that are rendered from draws of the category, with coloured
  backgrounds, errors of masks, and images cut off; {steps} steps of {batch} images, and {more} of {fewer} for the silhouettes of
  its means, too; {minutes:.0f} minutes of one core. Its negative log density of the parameters is
  {loss:.1f} nats on validation images, {before:.1f} before the silhouettes (that of the prior,
  without an image, is {prior:.1f}).
- **Not for**: poses unlike those of the clips; several bodies in one mask; photographs whose colours
  matter (colours are smooth and the light is one lamp). No photograph was used.
- **Measured**: {measured}.

Command: `python notebooks/ship_images.py {name} --data ../shared/data --out runs/{name}-images`.
"""

PROVENANCE = {
    "quadruped": "`animal-vae.md`",
    "person": "walking, running and jumping of the training part of `motion2d.md`",
}

MEASURED = {
    "quadruped": """200 synthetic images of held-out clips: overlap of silhouette and mask .873 ± .003, error of joints
  in 3D .056 ± .006 of the length of the body; 90 % intervals contain 91.3 ± .9 % (`python benchmarks/accuracy.py
  images`; ±: standard error)""",
    "person": """48 synthetic images of two held-out walks: overlap of silhouette and mask .80 ± .01, error of joints
  in 3D .091 ± .012 of the height of the body; 90 % intervals contain 88 ± 2 % (`python benchmarks/accuracy.py
  images --category person --images 48`; ±: standard error)""",
}


def clips_of(name: str, data: Path) -> list[Motion]:
    """Return the clips whose poses a category has; test and validation clips are not among them."""
    if name == "quadruped":
        return animal_clips(data)["train"]
    return moving_clips(data)["train"]


def windows_of(clips: Sequence[Motion], skeleton: Skeleton, fps: float) -> np.ndarray:
    """Return windows (N, FRAMES, J, 3) that overlap by half."""
    found = []
    for clip in clips:
        positions = clip.retarget(skeleton).resample(fps).positions
        starts = range(0, len(positions) - FRAMES + 1, FRAMES // 2)
        found += [positions[start : start + FRAMES] for start in starts]
    return np.array(found)


def speed_of(category: Category, turns: np.ndarray) -> float:
    """Return the mean speed of joints relative to the root, metres per second."""
    fixed = np.broadcast_to(np.eye(3), (*turns.shape[:2], 3, 3)), np.zeros((*turns.shape[:2], 3))
    joints = category.body.positions(turns, *fixed)
    return float(np.linalg.norm(np.diff(joints, axis=1), axis=-1).mean()) * category.code.fps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=sorted(PROVENANCE))
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    name: str = options.name
    torch.set_num_threads(1)
    vae = MotionVAE.load("animal-vae" if name == "quadruped" else "walk-vae")
    clips = clips_of(name, options.data)
    windows = windows_of(clips, vae.skeleton, vae.fps)
    fit = fit_turns(vae.body, windows)
    code = TurnCode.fit(fit.turns, vae.fps, DIM)
    category = Category.of_capsules(name, vae.body, code)
    draws = code.turns(np.random.default_rng(0).standard_normal((500, DIM)))
    speed = speed_of(category, draws) / speed_of(category, fit.turns)
    card = {"clips": sorted(clip.name for clip in clips), "windows": len(windows)}
    lengths = max(category.length_spread, float(np.sqrt((fit.log_lengths**2).mean())))
    category = replace(category, card=card, length_spread=lengths)
    category.save(WEIGHTS / f"{name}-images.npz")
    category = Category.load(name)
    results = []
    for settings in (TRAINING, SILHOUETTES):
        learnt = encoder_of(category) if results else None
        trainee = EncoderTrainee(category, learnt=learnt)
        folder = options.out / ("silhouettes" if results else "parameters")
        result = train(trainee, settings, folder, device="cpu", progress=False)
        checkpoint = load_checkpoint(result.model, trainee.kind)
        save_checkpoint(WEIGHTS / f"{name}-images.safetensors", checkpoint, half=True)
        results.append(result.saved)
    dim = trainee.network.dim
    text = CARD.format(
        name=name,
        parameters=sum(p.numel() for p in trainee.network.parameters()) / 1e6,
        windows=len(windows),
        frames=FRAMES,
        fps=vae.fps,
        clips=f"{len(clips)} clips",
        dim=DIM,
        error=1000 * fit.error,
        speed=speed,
        provenance=PROVENANCE[name],
        measured=MEASURED[name],
        steps=TRAINING.steps,
        batch=TRAINING.batch,
        more=SILHOUETTES.steps,
        fewer=SILHOUETTES.batch,
        minutes=sum(saved["seconds"] for saved in results) / 60,
        before=results[0]["validation_loss"],
        loss=results[1]["validation_loss"],
        # dim − 2 normal parameters and a uniform angle of a quarter turn, one of four
        prior=(dim - 2) * 0.5 * np.log(2 * np.pi * np.e) + np.log(2 * np.pi),
    )
    (WEIGHTS / f"{name}-images.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
