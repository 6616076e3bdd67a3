"""Fit a shipped spectral prior, ``cmu-motion`` or ``cmu-motion-coco17``, and write its card.

``python notebooks/ship_cmu_motion.py --data ../shared/data --skeleton coco17``
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from probmotion import seeds
from probmotion.arrays import logsumexp
from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.face_points import FACE_POINTS, head_turns, with_face_points
from probmotion.io.files import load
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.mixture.denoising import denoise_joints
from probmotion.models.mixture.fit import cut_windows
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.mixture.spectrum import to_frequencies
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.threads import one_thread

WEIGHTS = Path(__file__).parents[1] / "models" / "weights"
HELD_OUT_ACTION = "soccer"
NAMES = {"person14": "cmu-motion", "coco17": "cmu-motion-coco17"}
# Components of the two sources, chosen on left-out training and validation clips.
COMPONENTS = {"person14": (60, 20), "coco17": (45, 15)}
LIMBS = tuple(name for name in Skeleton.preset("coco17").joint_names if name not in FACE_POINTS)
TURNS_SEED, HELD_OUT_TURNS_SEED = 0, 1
HIDDEN = (slice(0, 6, 2), slice(7, 12, 2))  # limbs hidden in turn: the left arm, the right leg
NOISE = 0.04  # metres

CARD = """# {name}

Spectral mixture of human motion on `{skeleton}`, at 30 frames per second
({components} components, {counts[0]} of the first source and {counts[1]} of the second, at three scales, 24 headings): exact density, denoisers and posterior.

- **Data**: {minutes:.1f} minutes: the training clips of the denoising study (of
  CMU subjects 01, 02, 131 and of DeepMimic, `probmotion.data.denoising_clips`) and the clips of
  CMU's walking, running, jumping, basketball, referee signals and directing traffic; and the
  mirror images of all clips. Validation and test clips of the study are held out, and the action
  soccer as a whole.
{head}- **Provenance**: cmu_*, walk_*, …: mocap.cs.cmu.edu, free for research and commercial use; the
  database was created with funding from NSF EIA-0196217. humanoid3d_*: xbpeng/DeepMimic, MIT
  licence, © 2018 Xue Bin Peng.
- **Not for**: other body proportions than adults', joints other than those of `{skeleton}`, and
  getting up, flips and climbing without wide intervals: there are few such clips.

{rows}

Command (seconds of the fit on one thread: {seconds:.0f}):

    python notebooks/ship_cmu_motion.py --data ../shared/data{option}

Log density: in nats, positions in metres, of windows of two seconds with heading and ground position.
Error and intervals: of arms and legs, of which noisy positions (4 cm) are observed, an arm and
then a leg hidden for a third of the frames each, in five of every ten seconds; intervals contain this share of
coordinates. ±: standard error over clips.{limbs}
"""

HEAD = """- **Head**: the recordings have no nose, eyes and ears. These five points are *assumed*, not
  measured (`probmotion.data.face_points`): fixed to the head, at approximate means of adults.
  The head's vertical axis is that of the recorded head bone; DeepMimic has none, and its head
  continues the trunk. Turns of the head about this axis are not in the recordings: each clip was
  fitted twice, with a random turn (standard deviation 15°, correlation 0.5 after half a second,
  as in the few recordings with rotations) and with the opposite one. What the prior says of the
  face is therefore no measurement of how people move their heads.
"""

LIMB_NOTE = """

*Limbs* is the log density of the twelve joints of arms and legs alone, per coordinate, and after the
slash that under `cmu-motion`, as for errors. The face of held-out clips is placed as in
training, with other random turns. In draws, distances between points of the face vary by 2 to
4 cm (bones: by 5 to 9 cm): the prior does not know that they are constant."""


def main() -> None:
    """Fit, write and evaluate the prior."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="Folder of the recordings.")
    parser.add_argument(
        "--skeleton", choices=tuple(NAMES), default="person14", help="Joints of the prior."
    )
    arguments = parser.parse_args()
    data, skeleton = arguments.data, arguments.skeleton
    name, counts = NAMES[skeleton], COMPONENTS[skeleton]
    person = Skeleton.preset("person14")
    on_person = partial(Motion.retarget, skeleton=person)
    if skeleton == "person14":
        fitted, held_out = [recordings(data, on_person)], recordings(data, on_person)
    else:
        # Opposite turns are uncorrelated with the limbs, whatever the number of clips.
        fitted = [recordings(data, partial(faced, TURNS_SEED, sign)) for sign in (1, -1)]
        held_out = recordings(data, partial(faced, HELD_OUT_TURNS_SEED, 1))
    start = time.perf_counter()
    # The two sources place joints differently on the body, so that moments are not pooled.
    with one_thread():
        priors = []
        for part, count in zip(("train", "actions"), counts, strict=True):
            clips = [clip for version in fitted for clip in version[part]]
            both = [*clips, *map(mirrored, clips)]
            priors.append(SpectralMixtureMotion.fit(both, components=count))
    prior = joined(priors)
    seconds = time.perf_counter() - start
    training = held_out["train"] + held_out["actions"]
    minutes = sum(clip.frames / clip.fps for clip in training) / 60
    card = {"minutes": round(minutes, 1), "held out": HELD_OUT_ACTION, "command": "ship_cmu_motion"}
    replace(prior, card=card).save(WEIGHTS / f"{name}.npz")
    parts = {"training": training, "validation": held_out["validation"], "test": held_out["test"]}
    parts[f"{HELD_OUT_ACTION} (action kept out)"] = held_out["soccer"]
    models = [prior]
    columns = ["clips", "windows", "log density per coordinate", "error, mm", "90 % intervals"]
    if skeleton == "coco17":
        models.append(SpectralMixtureMotion.load(NAMES["person14"]))
        columns.insert(3, "limbs")
    rows = []
    for part, clips in parts.items():
        windows, density, error = log_density(prior, clips)
        row = [part, f"{windows}", f"{density:.2f} ± {error:.2f}"]
        if part == "training":  # too many windows for the other columns
            rows.append(row + ["–"] * (len(columns) - len(row)))
            continue
        if skeleton == "coco17":
            row.append(" / ".join(f"{limb_density(model, clips):.2f}" for model in models))
        errors, (inside, spread) = [], (np.nan, np.nan)
        for model in reversed(models):
            distance, (inside, spread) = limb_accuracy(model, clips)
            errors.insert(0, f"{1000 * distance:.1f}")
        row += [" / ".join(errors), f"{100 * inside:.0f} ± {100 * spread:.0f} %"]
        rows.append(row)
    table = [columns, ["---"] * len(columns), *rows]
    text = CARD.format(
        name=name,
        skeleton=skeleton,
        components=len(prior.weights),
        counts=counts,
        minutes=minutes,
        head=HEAD if skeleton == "coco17" else "",
        rows="\n".join(f"| {' | '.join(row)} |" for row in table),
        seconds=seconds,
        option="" if skeleton == "person14" else f" --skeleton {skeleton}",
        limbs=LIMB_NOTE if skeleton == "coco17" else "",
    )
    (WEIGHTS / f"{name}.md").write_text(text, encoding="utf-8")
    print(text)


def recordings(data: Path, convert: Callable[[Motion], Motion]) -> dict[str, list[Motion]]:
    """Return the parts of the denoising study, CMU's actions, and the action kept out."""
    clips = denoising_clips(data, convert)
    paths = sorted((data / "cmu_actions").glob("*.npz"))
    actions = [convert(load(path)).resample(30.0) for path in paths]
    clips["soccer"] = [clip for clip in actions if clip.name.startswith(HELD_OUT_ACTION)]
    clips["actions"] = [clip for clip in actions if clip not in clips["soccer"]]
    return clips


def faced(seed: int, sign: int, motion: Motion) -> Motion:
    """Return the motion on ``coco17``, its head with random turns of the recording, or opposite."""
    rng = seeds.generator(seed, "turns", motion.name)
    return with_face_points(motion, sign * head_turns(rng, motion.frames, motion.fps))


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


def log_density(
    prior: SpectralMixtureMotion, motions: Sequence[Motion]
) -> tuple[int, float, float]:
    """Return the number of windows, and mean and standard error of log densities per coordinate."""
    values = []
    for motion in motions:
        if motion.frames >= prior.frames:
            windows = windows_of([motion], prior.frames)
            values.append(prior.log_prior(windows) / windows[0].size)
    return sum(map(len, values)), *mean_and_error(values)


def mean_and_error(values: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the mean of all values, and its standard error if those of a clip are dependent."""
    mean, n = np.concatenate(values).mean(), len(values)
    sums = [(each - mean).sum() for each in values]
    error = np.sqrt(np.square(sums).sum() * n / (n - 1)) / sum(map(len, values))
    return float(mean), float(error)


def limb_density(prior: SpectralMixtureMotion, motions: Sequence[Motion]) -> float:
    """Return the mean log density per coordinate of the limbs alone, at unknown heading."""
    joints = [prior.skeleton.index(name) for name in LIMBS]
    subset = motions[0].skeleton.subset([motions[0].skeleton.index(name) for name in LIMBS])
    windows = windows_of([motion.retarget(subset) for motion in motions], prior.frames)
    n, L, J, _ = windows.shape
    turned = np.stack([turned_about_vertical(windows, np.full(n, -yaw)) for yaw in prior.yaws])
    coefficients = to_frequencies(turned.reshape(-1, L, 3 * J), axis=1)
    terms = []
    for part in prior.components.gaussians:
        mean = to_frequencies(part.mean[:, joints].reshape(L, -1), axis=0)
        rows = part.directions.reshape(len(part.directions), -1, 3, part.variances.shape[1])
        V = rows[:, joints].reshape(len(rows), 3 * J, -1)[part.band]
        root = np.linalg.cholesky((V * part.variances[:, None]) @ V.swapaxes(1, 2))
        scores = np.linalg.inv(root) @ (coefficients - mean).transpose(1, 2, 0)
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum()
        terms.append(-0.5 * (scores**2).sum(axis=(0, 1)) - log_det)
    log_weights = prior.components.log_weights[:, None, None]
    joint = np.stack(terms).reshape(len(terms), len(prior.yaws), n) + log_weights
    values = logsumexp(joint.reshape(-1, n).T) - 0.5 * L * 3 * J * np.log(2 * np.pi)
    return float(np.mean(values)) / (L * 3 * J)


def limb_accuracy(
    prior: SpectralMixtureMotion, motions: Sequence[Motion]
) -> tuple[float, tuple[float, float]]:
    """Return error (metres) and coverage of limbs denoised from noisy limbs with gaps.

    Coverage is the share of coordinates in 90 % intervals, with its standard error over clips.
    """
    joints = [prior.skeleton.index(name) for name in LIMBS]
    errors, inside = [], []
    for motion in motions:
        shares = []
        limbs = motion.positions[:, [motion.skeleton.index(name) for name in LIMBS]]
        for start in range(0, max(motion.frames - 149, 1), 300):
            truth = limbs[start : start + 150]
            frames = len(truth)
            rng = seeds.generator(0, "noise", motion.name, start)
            noisy = truth + NOISE * rng.standard_normal(truth.shape)
            for begin, part in zip((0, frames // 2), HIDDEN, strict=True):
                noisy[begin : begin + frames // 3, part] = np.nan
            observed = np.full((frames, prior.skeleton.n_joints, 3), np.nan)
            observed[:, joints] = noisy
            result = denoise_joints(
                observed,
                skeleton=prior.skeleton,
                fps=motion.fps,
                noise=NOISE,
                draws=0,
                progress=False,
                prior=prior,
            )
            error = result.mean[:, joints] - truth
            errors.append(np.linalg.norm(error, axis=-1).mean())
            shares.append((np.abs(error) < 1.645 * result.sd[:, joints]).mean())
        inside.append(np.array(shares))
    return float(np.mean(errors)), mean_and_error(inside)


def windows_of(motions: Sequence[Motion], frames: int) -> np.ndarray:
    """Return the windows of the motions that are long enough, about their ground position."""
    long = [motion for motion in motions if motion.frames >= frames]
    windows, _ = cut_windows(long, frames, centred=False)
    windows -= windows.mean(axis=(1, 2), keepdims=True) * [1.0, 0.0, 1.0]
    return windows


if __name__ == "__main__":
    main()
