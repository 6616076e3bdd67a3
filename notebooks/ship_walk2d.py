"""Write the weights, features and model card of walk2d from its training runs.

    python notebooks/ship_walk2d.py --runs runs

``--list`` prints the training clips; the commands of the runs are in the model card,
``models/weights/walk2d.md``. Prior and evaluator are written in half precision. Clips are read from
``--data``, by default ../shared/data beside the repository.
"""

from __future__ import annotations

import argparse
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from probmotion.data.projections import Filming
from probmotion.data.synthetic.walks import WALK_CLIPS, walk_clips
from probmotion.data.tracks.learning import film_windows
from probmotion.files import written_whole
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.training.checkpoints import WEIGHTS
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.motion.motion import Motion

ROOT = Path(__file__).parents[1]
WINDOWS = 1000
ROWS = ("truth, 2D", "truth, 3D", "2D model", "MAS", "mvpc")
COMMANDS = (
    'C="--clips $(python notebooks/ship_walk2d.py --list clips)"',
    'C="$C --validation $(python notebooks/ship_walk2d.py --list validation)"',
    'C="$C --test $(python notebooks/ship_walk2d.py --list test)"',
    "probmotion train diffusion --out runs/walk2d $C",
    "probmotion train evaluator --out runs/walk2d-evaluator $C",
    "python notebooks/ship_walk2d.py --runs runs",
)


def main() -> None:
    """Write weights, features and card, or list the clips."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="Folder of training runs.")
    data = ROOT.parent / "shared" / "data"
    parser.add_argument("--data", type=Path, default=data, help="Folder of the clips.")
    parser.add_argument(
        "--table", type=Path, help="table.csv written by notebooks/ablations/mas.py."
    )
    parts = ["clips", "validation", "test"]
    parser.add_argument("--list", choices=parts, help="Print all clips or those of a part.")
    options = parser.parse_args()
    if options.list:
        print(" ".join(clip_names(options.list, options.data)))
        return
    prior = MotionDiffusion.load(options.runs / "walk2d")
    evaluator = TrackEvaluator.load(options.runs / "walk2d-evaluator")
    prior.save(WEIGHTS / "walk2d.safetensors", half=True)
    evaluator.save(WEIGHTS / "walk2d-evaluator.safetensors", half=True)
    # The features must be those of the shipped half-precision weights.
    evaluator = TrackEvaluator.load("walk2d-evaluator")
    write_features("walk2d", evaluator, prior, walk_clips(options.data))
    lines = card_lines(prior.card, evaluator.card)
    if options.table is not None:
        lines += result_lines(pd.read_csv(options.table))
    card = "\n".join(lines)
    with written_whole(WEIGHTS / "walk2d.md") as path:
        path.write_text(card + "\n", encoding="utf-8")
    print(card)


def clip_names(part: str, data: Path) -> list[str]:
    """Return the files of all clips, or the names of the clips of a part."""
    if part == "clips":
        return [str(data / f"{name}.npz") for names in WALK_CLIPS.values() for name in names]
    return [Path(name).name for name in WALK_CLIPS[part]]


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


def card_lines(prior: dict[str, Any], evaluator: dict[str, Any]) -> list[str]:
    """Return the model card: data, training and results."""
    size, data = prior["network"]["size"], prior["network"]["data"]
    lines = [
        "# walk2d",
        "",
        "2D motion diffusion model of walking people in one view (MAS, section 6.2), and the",
        "evaluator for its scores. Motions have up to "
        f"{size['frames']} frames of {len(prior['network']['joint_names'])} joints at "
        f"{prior['network']['fps']:g} frames per second, with the pelvis at the origin.",
        "",
        "- **Data**: 2D projections of 3D clips to random cameras (elevation "
        f"{math.degrees(Filming().elevation):.2f}° ± {math.degrees(Filming().tilt):.0f}°, 7 m) with",
        "  detection errors. Training clips: "
        f"{', '.join(data['clips'])} ({data['tracks']} tracks, {data['frames']} frames).",
        f"  Validation clips: {', '.join(prior['network']['validation_data']['clips'])}.",
        f"  Test clips: {', '.join(clip_names('test', Path()))}.",
        "- **Provenance**: humanoid3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng.",
        "  cmu_*: mocap.cs.cmu.edu, free for research and commercial use; the database was created",
        "  with funding from NSF EIA-0196217.",
        "- **Not for**: other actions, cameras far above or below the subject, or tracks that are",
        "  not centred. The training data contain few bodies, so body proportions vary little.",
        "",
        "| network | layers × width | steps | batch | seconds | loss (training / validation) |",
        "|---|---|---|---|---|---|",
    ]
    for name, card in (("prior", prior), ("evaluator", evaluator)):
        shape, last = card["network"]["size"], card["history"][-1]
        lines.append(
            f"| {name} | {shape['layers']} × {shape['width']} | {card['step']} "
            f"| {card['training']['batch']} | {card['seconds']:.0f} | {last['loss']:.4f} "
            f"/ {last['validation_loss']:.4f} |"
        )
    return [
        *lines,
        "",
        "Seconds: duration of training on one thread of a shared CPU; no GPU was used. One other",
        "clip of the person in the validation clip is a training clip. Commands:",
        "",
        *(f"    {line}" for line in COMMANDS),
    ]


def result_lines(table: pd.DataFrame) -> list[str]:
    """Return the rows for the prior in the table of the ablation."""
    columns = ("fid_learnt", "precision_learnt", "recall_learnt", "fid", "to_real_mm")
    lines = [
        "",
        "Scores (`python notebooks/ablations/mas.py`; FID: Fréchet inception distance; ±: standard",
        "deviation over random halves of the draws and random views). Lower is better, except for",
        "precision and recall.",
        "",
        "| | FID | precision | recall | FID, test clips | distance to 3D test clips, mm |",
        "|---|---|---|---|---|---|",
    ]
    for _, row in table[table["name"].isin(ROWS)].iterrows():
        cells = []
        for name in columns:
            spread = row.get(f"{name}_sd", math.nan)
            number = "" if math.isnan(row[name]) else f"{row[name]:.3g}"
            cells.append(number if math.isnan(spread) else f"{number} ± {spread:.2g}")
        lines.append(f"| {row['name']} | {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    main()
