"""Fit the shipped spectral prior ``cmu-motion`` and write its card.

``python notebooks/ship_cmu_motion.py --data ../shared/data``
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.data.denoising_clips import denoising_clips
from probmotion.io.files import load
from probmotion.models.mixture.fit import cut_windows
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.threads import one_thread

WEIGHTS = Path(__file__).parents[1] / "models" / "weights"
HELD_OUT_ACTION = "soccer"
COMPONENTS = (60, 20)  # of the two sources, chosen on left-out training and validation clips

CARD = """# cmu-motion

Spectral mixture of human motion on `person14`, at 30 frames per second
({components} components, {counts[0]} of the first source and {counts[1]} of the second, at three scales, 24 headings): exact density, denoisers and posterior.

- **Data**: {minutes:.1f} minutes: the training clips of the denoising study (of
  CMU subjects 01, 02, 131 and of DeepMimic, `probmotion.data.denoising_clips`) and the clips of
  CMU's walking, running, jumping, basketball, referee signals and directing traffic; and the
  mirror images of all clips. Validation and test clips of the study are held out, and the action
  soccer as a whole.
- **Provenance**: cmu_*, walk_*, …: mocap.cs.cmu.edu, free for research and commercial use; the
  database was created with funding from NSF EIA-0196217. humanoid3d_*: xbpeng/DeepMimic, MIT
  licence, © 2018 Xue Bin Peng.
- **Not for**: other body proportions than adults', joints other than those of `person14`, and
  getting up, flips and climbing without wide intervals: there are few such clips.

| clips | windows | log density per coordinate |
|---|---|---|
{rows}

Command (seconds of the fit on one thread: {seconds:.0f}):

    python notebooks/ship_cmu_motion.py --data ../shared/data

Two-second windows; the log density (nats, positions in metres) includes heading and ground
position.
"""


def main() -> None:
    """Fit, write and evaluate the prior."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="Folder of the recordings.")
    data = parser.parse_args().data
    clips = denoising_clips(data)
    person = Skeleton.preset("person14")
    actions = [
        load(path).retarget(person).resample(30.0)
        for path in sorted((data / "cmu_actions").glob("*.npz"))
    ]
    held_out = [clip for clip in actions if clip.name.startswith(HELD_OUT_ACTION)]
    kept = [clip for clip in actions if clip not in held_out]
    training = clips["train"] + kept
    start = time.perf_counter()
    # The two sources place joints differently on the body, so that moments are not pooled.
    with one_thread():
        priors = [
            SpectralMixtureMotion.fit([*part, *map(mirrored, part)], components=count)
            for part, count in zip((clips["train"], kept), COMPONENTS, strict=True)
        ]
    prior = joined(priors)
    seconds = time.perf_counter() - start
    parts = {"training": training, "validation": clips["validation"], "test": clips["test"]}
    parts[f"{HELD_OUT_ACTION} (action kept out)"] = held_out
    rows = [f"| {name} | {n} | {density:.2f} |" for name, n, density in densities(prior, parts)]
    minutes = sum(clip.frames / clip.fps for clip in training) / 60
    card = {"minutes": round(minutes, 1), "held out": HELD_OUT_ACTION, "command": "ship_cmu_motion"}
    replace(prior, card=card).save(WEIGHTS / "cmu-motion.npz")
    text = CARD.format(
        components=len(prior.weights),
        counts=COMPONENTS,
        minutes=minutes,
        rows="\n".join(rows),
        seconds=seconds,
    )
    (WEIGHTS / "cmu-motion.md").write_text(text, encoding="utf-8")
    print(text)


def mirrored(motion: Motion) -> Motion:
    """Return the motion with left and right exchanged."""
    order = list(motion.skeleton.mirrored_order)
    return replace(motion, positions=motion.positions[:, order] * [-1.0, 1.0, 1.0])


def joined(priors: Sequence[SpectralMixtureMotion]) -> SpectralMixtureMotion:
    """Return the mixture of priors with equal weights."""
    arrays = ("poses", "velocities", "directions", "variances")
    stacked = {name: np.concatenate([getattr(p, name) for p in priors]) for name in arrays}
    weights = np.concatenate([p.weights for p in priors]) / len(priors)
    return replace(priors[0], weights=weights, **stacked)


def densities(
    prior: SpectralMixtureMotion, parts: dict[str, Sequence[Motion]]
) -> list[tuple[str, int, float]]:
    """Return name, number of windows and mean log density per coordinate of each part."""
    out = []
    for name, motions in parts.items():
        long = [motion for motion in motions if motion.frames >= prior.frames]
        windows, _ = cut_windows(long, prior.frames, centred=False)
        windows -= windows.mean(axis=(1, 2), keepdims=True) * [1.0, 0.0, 1.0]
        density = float(np.mean(prior.log_prior(windows))) / windows[0].size
        out.append((name, len(windows), density))
    return out


if __name__ == "__main__":
    main()
