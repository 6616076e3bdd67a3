"""Train walk2d or motion2d and write its weights, features and model card.

    python notebooks/ship_diffusion.py walk2d --runs runs
    python notebooks/ship_diffusion.py motion2d --runs runs

Run the command again to resume a stopped run. Prior and evaluator are written to ``models/weights``
in half precision, with the features of held-out and training views. Clips are read from ``--data``,
by default ../shared/data beside the repository, and projected to 2D.
"""

from __future__ import annotations

import argparse
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from probmotion.data.person_clips import moving_clips
from probmotion.data.projections import Filming
from probmotion.data.synthetic.walks import walk_clips
from probmotion.data.tracks.learning import film_clips, film_windows
from probmotion.files import written_whole
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
from probmotion.models.training.checkpoints import WEIGHTS
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

ROOT = Path(__file__).parents[1]
PERSON, FPS = Skeleton.preset("person14"), 20.0
WINDOWS = 1000
ROWS = ("truth, 2D", "truth, 3D", "2D model", "MAS", "mvpc")


@dataclass(frozen=True)
class Kind:
    """Clips, training and sentences of the card of one prior."""

    about: str
    clips: Callable[[str | Path], dict[str, list[Motion]]]
    size: DiffusionSettings
    steps: Mapping[str, int]
    """Number of training steps of prior and evaluator."""
    cmu: str
    """Names of the clips of CMU."""
    not_for: str
    calibration: str
    device: str
    notes: str


KINDS = {
    "walk2d": Kind(
        about="walking people",
        clips=walk_clips,
        size=DiffusionSettings.small(),
        steps={"prior": 12_000, "evaluator": 5000},
        cmu="cmu_*",
        not_for="other actions",
        calibration="given keypoints of one camera, draws are overconfident: errors of the mean are "
        "7 ± 3 (MAS), 11 ± 2 (mvpc) and 19 ± 6 (split-gibbs) times the predicted ones. "
        "For an exact spectral mixture of the same tracks (K = 8) it is 1.8 ± .3; its "
        "draws have a lower FID to test clips (13.3; MAS 18.4) and less precision (.33; "
        "MAS .81). See docs/studies/mas.md.",
        device="one thread of a shared CPU; no GPU was used",
        notes="One other clip of the person in the validation clip is a training clip.",
    ),
    "motion2d": Kind(
        about="people who walk, run and jump",
        clips=moving_clips,
        size=DiffusionSettings.small(),
        steps={"prior": 12_000, "evaluator": 2000},
        cmu="cmu_*, jumping_*, running_*, walk_*, walking_*",
        not_for="other actions, runs of more than 1.5 s (the longest of the training clips)",
        calibration="given keypoints of one camera, draws are overconfident: errors of the mean are "
        "3.4 ± .6 (MAS), 8 ± 2 (mvpc) and 30 ± 4 (split-gibbs) times the predicted "
        "ones. A spectral mixture of the same tracks (K = 8) has an FID of 6.3 ± .4, but "
        "10.6 ± .5 to test clips and a precision of .42 ± .05. See docs/studies/mas.md.",
        device="one thread of a shared CPU for the prior and one NVIDIA H200, shared with other jobs, "
        "for the evaluator",
        notes="Clips are split by probmotion/data/person_clips.csv; test clips are other takes "
        "of the same actions as training clips, and soccer is kept out whole. After 2000 steps, "
        "a width of 160 gave no clearly lower FID against validation clips (21.1 ± 0.5, this "
        "network 21.9 ± 0.7; three sets of draws), dropout of 0.1 a higher one (24.6 ± 0.9).",
    ),
}


def main() -> None:
    """Train both networks unless finished, and write weights, features and card."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", choices=KINDS, help="Name of the prior.")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="Folder of training runs.")
    data = ROOT.parent / "shared" / "data"
    parser.add_argument("--data", type=Path, default=data, help="Folder of the clips.")
    parser.add_argument(
        "--table", type=Path, help="sets.csv written by notebooks/ablations/mas.py."
    )
    options = parser.parse_args()
    name, kind = options.name, KINDS[options.name]
    clips = kind.clips(options.data)
    folder = options.runs / name
    train_networks(kind, clips, folder)
    prior = MotionDiffusion.load(folder / "prior")
    evaluator = TrackEvaluator.load(folder / "evaluator")
    prior.save(WEIGHTS / f"{name}.safetensors", half=True)
    evaluator.save(WEIGHTS / f"{name}-evaluator.safetensors", half=True)
    # The features must be those of the shipped half-precision weights.
    evaluator = TrackEvaluator.load(f"{name}-evaluator")
    write_features(name, evaluator, prior, clips)
    lines = card_lines(name, prior.card, evaluator.card, clips["test"])
    if options.table is not None:
        lines += result_lines(name, pd.read_csv(options.table))
    card = "\n".join(lines)
    with written_whole(WEIGHTS / f"{name}.md") as path:
        path.write_text(card + "\n", encoding="utf-8")
    print(card)


def train_networks(kind: Kind, clips: dict[str, list[Motion]], folder: Path) -> None:
    """Train prior and evaluator in folders of their names."""
    data = [
        film_clips(sorted(clips[part], key=lambda clip: clip.name), PERSON, FPS).tracks
        for part in ("train", "validation")
    ]
    trainees = {
        "prior": DiffusionTrainee(*data, kind.size),
        "evaluator": EvaluatorTrainee(*data, EvaluatorSettings.small()),
    }
    for name, trainee in trainees.items():
        settings = TrainingSettings(steps=kind.steps[name], learning_rate=1e-3)
        train(trainee, settings, folder / name)


def write_features(
    name: str,
    evaluator: TrackEvaluator,
    prior: MotionDiffusion | MotionVAE,
    clips: dict[str, list[Motion]],
) -> None:
    """Write features of random windows of test and training clips and their cameras."""
    filming, features = Filming(), {}
    for seed, (part, key) in enumerate((("test", "held_out"), ("train", "learnt")), start=1):
        views = film_windows(
            clips[part], prior.skeleton, prior.fps, prior.frames, WINDOWS, seed=seed
        )
        features[key] = evaluator.features(views).astype(np.float16)
    archive = io.BytesIO()
    np.savez_compressed(archive, elevation=filming.elevation, distance=filming.distance, **features)
    with written_whole(WEIGHTS / f"{name}-features.npz") as path:
        path.write_bytes(archive.getvalue())


def card_lines(
    name: str, prior: dict[str, Any], evaluator: dict[str, Any], test: list[Motion]
) -> list[str]:
    """Return the model card: data, training and results."""
    kind, size, data = KINDS[name], prior["network"]["size"], prior["network"]["data"]
    training = f"{listed(data['clips'])} ({data['tracks']} tracks, {data['frames']} frames)"
    lines = [
        f"# {name}",
        "",
        f"2D motion diffusion model of {kind.about} in one view (MAS, section 6.2), and the",
        "evaluator for its scores. Motions have up to "
        f"{size['frames']} frames of {len(prior['network']['joint_names'])} joints at "
        f"{prior['network']['fps']:g} frames per second, with the pelvis at the origin.",
        "",
        "- **Data**: 2D projections of 3D clips to random cameras (elevation "
        f"{math.degrees(Filming().elevation):.2f}° ± {math.degrees(Filming().tilt):.0f}°, 7 m) with",
        f"  detection errors. Training clips: {training}.",
        f"  Validation clips: {listed(prior['network']['validation_data']['clips'])}.",
        f"  Test clips: {listed(clip.name for clip in test)}.",
        "- **Provenance**: humanoid3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng.",
        f"  {kind.cmu}: mocap.cs.cmu.edu, free for research and commercial use; the database was created",
        "  with funding from NSF EIA-0196217.",
        f"- **Not for**: {kind.not_for}, cameras far above or below the subject, or tracks that are",
        "  not centred. The training data contain few bodies, so body proportions vary little.",
        textwrap.fill(f"- **Calibration**: {kind.calibration}", 100, subsequent_indent="  "),
        "",
        "| network | layers × width | steps | batch | seconds | loss (training / validation) |",
        "|---|---|---|---|---|---|",
    ]
    for part, card in (("prior", prior), ("evaluator", evaluator)):
        shape, last = card["network"]["size"], card["history"][-1]
        lines.append(
            f"| {part} | {shape['layers']} × {shape['width']} | {card['step']} "
            f"| {card['training']['batch']} | {card['seconds']:.0f} | {last['loss']:.4f} "
            f"/ {last['validation_loss']:.4f} |"
        )
    return [
        *lines,
        "",
        textwrap.fill(f"Seconds: training time on {kind.device}. {kind.notes} Command:", 100),
        "",
        f"    python notebooks/ship_diffusion.py {name} --runs runs",
    ]


def listed(names: Iterable[str]) -> str:
    """Return names in order, separated by commas."""
    return ", ".join(sorted(names))


def result_lines(name: str, table: pd.DataFrame) -> list[str]:
    """Return the means over the sets of draws in a table of the ablation."""
    columns = ("fid_learnt", "precision_learnt", "recall_learnt", "fid", "to_real_mm")
    lines = [
        "",
        f"Scores of 512 draws (`python notebooks/ablations/mas.py --prior {name} --parts sets --draws 512`;",
        "FID: Fréchet inception distance; 2D model: means of three sets of draws; ±: standard deviation",
        "over random halves of a set and random views). Lower is better, except for precision and recall.",
        "",
        "| | FID | precision | recall | FID, test clips | distance to 3D test clips, mm |",
        "|---|---|---|---|---|---|",
    ]
    means = table.groupby("name").mean(numeric_only=True)
    for row_name in ROWS:
        row, cells = means.loc[row_name], []
        for column in columns:
            spread = row.get(f"{column}_sd", math.nan)
            number = "" if math.isnan(row[column]) else f"{row[column]:.3g}"
            cells.append(number if math.isnan(spread) else f"{number} ± {spread:.2g}")
        lines.append(f"| {row_name} | {' | '.join(cells)} |")
    speed = means.loc["2D model", "speed"] / means.loc["truth, 2D", "speed"]
    closing = (
        f"Joints of 2D draws move at {speed:.2f} times the speed of the training views (means over "
        "five frames)."
    )
    return [*lines, "", closing]


if __name__ == "__main__":
    main()
