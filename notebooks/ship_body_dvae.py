"""Train body-dvae and write its weights and model card.

    python notebooks/ship_body_dvae.py --runs runs

Run the command again to resume a stopped run. Both networks are written to ``models/weights`` in
half precision; the denoiser is trained with the half-precision prior. Clips are read from ``--data``, by default ../shared/data beside the repository.
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
    """Train both networks unless finished, and write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="Folder of training runs.")
    data = ROOT.parent / "shared" / "data"
    parser.add_argument("--data", type=Path, default=data, help="Folder of the clips.")
    table = "table.csv written by notebooks/ablations/motion_dvae.py."
    parser.add_argument("--table", type=Path, help=table)
    options = parser.parse_args()
    clips = denoising_clips(options.data)
    prior = trained_prior(clips, options.runs / NAME)
    refit_joint_scale(prior, clips["validation"])
    prior.save(WEIGHTS / f"{NAME}.safetensors", half=True)
    # The denoiser must be trained with the shipped half-precision weights.
    prior = MotionDVAE.load(NAME)
    denoiser = trained_denoiser(clips, prior, options.runs / f"{NAME}-denoiser")
    denoiser.save(WEIGHTS / f"{NAME}-denoiser.safetensors", half=True)
    with written_whole(WEIGHTS / f"{NAME}.md") as path:
        path.write_text(card(prior, denoiser, options.table), encoding="utf-8")
    print(f"wrote {WEIGHTS / NAME}*")


def trained_prior(clips: dict[str, list[Motion]], folder: Path) -> MotionDVAE:
    """Return the prior, trained in a folder."""
    training = clips["train"]
    rest = rest_pose(training[0].skeleton, [clip.positions for clip in training])
    settings, annealing = usual_dvae_training("small")
    trainee = DVAETrainee(
        training,
        clips["validation"],
        DVAESettings.small(),
        BodyStates(training[0].skeleton, rest),
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
    validation = ", ".join(network["validation_data"]["clips"])
    rows = "\n".join(
        _row(name, record) for name, record in (("prior", prior.card), ("denoiser", denoiser.card))
    )
    return f"""# {NAME}

Autoregressive prior over human motion: a Motion-DVAE (Fiche et al. 2023, supplement A) with the
cumulative decoder, and its inference networks for denoising. Windows have {size.frames} frames of
{prior.skeleton.n_joints} joints at {prior.fps:g} frames per second; z has {size.latent} dimensions, and
layers have width {size.hidden}.

- **Data**: {network["data"]["frames"]} frames and their mirror images. Training clips: {names}.
  Validation clips: {validation};
  the error of their decoded joints is {1000 * prior.joint_scale:.0f} mm. Test clips: see
  `probmotion.data.denoising_clips`.
- **Noise in training**: σ {1000 * noise["least"]:g} to {1000 * noise["most"]:g} mm;
  {noise["outliers"]:.0%} of windows Student-t with 2 to 8 degrees of freedom,
  {noise["hidden"]:.0%} with occluded limbs.
- **Provenance**: humanoid3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng.
  cmu_*: mocap.cs.cmu.edu, free for research and commercial use; the database was created
  with funding from NSF EIA-0196217.
- **Not for**: other skeletons, frame rates other than {prior.fps:g}, children and animals.
  Except for climbing and walking, an action has only one or two training clips.
- **Compared with `cmu-motion`**: alone, this network is not better than the exact spectral prior and is
  kept as the paper's method. It is used after `joint-corrector`, as a correction of spectral posteriors.

| network | weights | steps | batch | seconds | loss (training / validation) |
|---|---|---|---|---|---|
{rows}

Seconds: duration of training on one thread of a shared CPU; no GPU was used. The loss of the
denoiser is the negative evidence lower bound per frame; that of the prior also includes the error of joints.
The prior with the lowest validation loss is shipped.
Command: `python notebooks/ship_body_dvae.py --runs runs`.
{_results(table)}"""


def _row(name: str, record: dict[str, Any]) -> str:
    last = next(row for row in record["history"] if row["step"] == record["step"])
    training = record["training"]
    file = NAME if name == "prior" else f"{NAME}-denoiser"
    size = (WEIGHTS / f"{file}.safetensors").stat().st_size / 1e6
    return (
        f"| {name} | {size:.1f} MB | {record['step']} | {training['batch']} | "
        f"{record['seconds']:.0f} | {last['loss']:.1f} / {last['validation_loss']:.1f} |"
    )


def _results(table: Path | None) -> str:
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
        "\nMean errors on the test clips in mm (`python notebooks/ablations/motion_dvae.py`; lower is\n"
        "better; G-MPJPE: global mean per-joint position error; acceleration ratio: 1 is best).\n\n"
        "| recording | estimate | G-MPJPE | G-MPJPE, occluded joints | acceleration ratio |\n"
        "|---|---|---|---|---|\n"
    )
    return head + "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
