"""Train body-dvae and write the weights and model card that the package ships.

    python notebooks/ship_body_dvae.py --runs runs

A stopped run continues; a finished one is not repeated. Both networks are written to
``models/weights`` in half precision. The denoiser is trained with the prior as it is shipped. Clips
are read from ``--data``, by default ../shared/data beside the repository.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pandas as pd

from probmotion.data.denoising_clips import denoising_clips
from probmotion.files import written_whole
from probmotion.models.bodies.body_states import BodyStates, rest_pose
from probmotion.models.dvae.denoiser_training import DenoiserTrainee, usual_denoiser_training
from probmotion.models.dvae.motion_denoiser import MotionDenoiser
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.training import DVAETrainee, refit_joint_scale, usual_dvae_training
from probmotion.models.training.checkpoints import WEIGHTS
from probmotion.models.training.trainer import train
from probmotion.motion.motion import Motion

ROOT = Path(__file__).parents[1]
NAME = "body-dvae"


def main() -> None:
    """Train what is missing; write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument(
        "--table", type=Path, help="table.csv of notebooks/ablations/motion_dvae.py"
    )
    asked = parser.parse_args()
    clips = denoising_clips(asked.data)
    prior = trained_prior(clips, asked.runs / NAME)
    refit_joint_scale(prior, clips["validation"])
    prior.save(WEIGHTS / f"{NAME}.safetensors", half=True)
    # As it will be loaded: half-precision weights.
    prior = MotionDVAE.load(NAME)
    denoiser = trained_denoiser(clips, prior, asked.runs / f"{NAME}-denoiser")
    denoiser.save(WEIGHTS / f"{NAME}-denoiser.safetensors", half=True)
    with written_whole(WEIGHTS / f"{NAME}.md") as path:
        path.write_text(card(prior, denoiser, asked.table), encoding="utf-8")
    print(f"wrote {WEIGHTS / NAME}*")


def trained_prior(clips: dict[str, list[Motion]], folder: Path) -> MotionDVAE:
    """Return the prior, trained in a folder."""
    learnt = clips["train"]
    rest = rest_pose(learnt[0].skeleton, [clip.positions for clip in learnt])
    settings, annealing = usual_dvae_training("small")
    trainee = DVAETrainee(
        learnt,
        clips["validation"],
        DVAESettings.small(),
        BodyStates(learnt[0].skeleton, rest),
        annealing=annealing,
    )
    train(trainee, settings, folder)
    return MotionDVAE.load(folder)


def trained_denoiser(
    clips: dict[str, list[Motion]], prior: MotionDVAE, folder: Path
) -> MotionDenoiser:
    """Return the prior's denoiser, trained in a folder."""
    settings, annealing = usual_denoiser_training("small")
    trainee = DenoiserTrainee(clips["train"], clips["validation"], prior, annealing=annealing)
    train(trainee, settings, folder)
    return MotionDenoiser.load(folder, prior)


def card(prior: MotionDVAE, denoiser: MotionDenoiser, table: Path | None) -> str:
    """Return the model card."""
    network = prior.card["network"]
    size = prior.settings
    noise = denoiser.card["network"]["noise"]
    names = ", ".join(network["data"]["clips"])
    watched = ", ".join(network["validation_data"]["clips"])
    rows = "\n".join(
        _row(name, kept) for name, kept in (("prior", prior.card), ("denoiser", denoiser.card))
    )
    return f"""# {NAME}

What a body does next: a Motion-DVAE (supplement of the paper, A) with the cumulative decoder,
and the inference networks that denoise beside it. Windows of {size.frames} frames of
{prior.skeleton.n_joints} joints at {prior.fps:g} frames per second; z of {size.latent} numbers,
layers of {size.hidden}.

- **Data**: {network["data"]["frames"]} frames and their mirror images, of {names}.
  The loss is watched on {watched}; the error of
  decoded joints, {1000 * prior.joint_scale:.0f} mm, is that of these clips. Clips that were held
  out whole: see `probmotion.data.denoising_clips`.
- **Noise learnt from**: σ {1000 * noise["least"]:g} to {1000 * noise["most"]:g} mm;
  {noise["outliers"]:.0%} of windows Student-t with 2 to 8 degrees of freedom,
  {noise["hidden"]:.0%} with limbs that hide.
- **Provenance**: humanoid3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng.
  cmu_*: mocap.cs.cmu.edu, free for research and commercial use; the database was created
  with funding from NSF EIA-0196217.
- **Not for**: other skeletons, frame rates other than {prior.fps:g}, children and animals; what
  few clips show (climbing apart, actions have one or two clips each) is known poorly.

| network | weights | steps | batch | seconds | loss | validation loss |
|---|---|---|---|---|---|---|
{rows}

Seconds are of training steps on one thread of a shared CPU; no GPU was used. The denoiser's loss is
minus the evidence lower bound per frame; the prior's is that of states, with the error of joints
counted beside it. The prior is that of the lowest validation loss.
Command: `python notebooks/ship_body_dvae.py --runs runs`.
{_measured(table)}"""


def _row(name: str, kept: dict[str, Any]) -> str:
    last = next(row for row in kept["history"] if row["step"] == kept["step"])
    training = kept["training"]
    file = NAME if name == "prior" else f"{NAME}-denoiser"
    size = (WEIGHTS / f"{file}.safetensors").stat().st_size / 1e6
    return (
        f"| {name} | {size:.1f} MB | {kept['step']} | {training['batch']} | "
        f"{kept['seconds']:.0f} | {last['loss']:.1f} | {last['validation_loss']:.1f} |"
    )


def _measured(table: Path | None) -> str:
    if table is None:
        return ""
    rows = pd.read_csv(table)
    shown = rows[["kind", "estimate", "g_mpjpe", "g_mpjpe_occluded", "acceleration_ratio"]]
    lines = [
        f"| {row.kind} | {row.estimate} | {row.g_mpjpe:.1f} | "
        + ("" if pd.isna(row.g_mpjpe_occluded) else f"{row.g_mpjpe_occluded:.1f}")
        + f" | {row.acceleration_ratio:.2f} |"
        for row in shown.itertuples()
    ]
    head = (
        "\nMeasured by `python notebooks/ablations/motion_dvae.py` on the clips held out, mm:\n\n"
        "| recording | estimate | G-MPJPE | occluded joints | acceleration relative to the truth's |\n"
        "|---|---|---|---|---|\n"
    )
    return head + "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
