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
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--table", type=Path, help="table.csv of notebooks/ablations/mas.py")
    parser.add_argument("--list", choices=["clips", "validation", "test"])
    asked = parser.parse_args()
    if asked.list:
        print(" ".join(listed(asked.list, asked.data)))
        return
    prior = MotionDiffusion.load(asked.runs / "walk2d")
    evaluator = TrackEvaluator.load(asked.runs / "walk2d-evaluator")
    prior.save(WEIGHTS / "walk2d.safetensors", half=True)
    evaluator.save(WEIGHTS / "walk2d-evaluator.safetensors", half=True)
    # As they will be loaded: features of half-precision weights.
    evaluator = TrackEvaluator.load("walk2d-evaluator")
    write_features("walk2d", evaluator, prior, walk_clips(asked.data))
    lines = card_lines(prior.card, evaluator.card)
    if asked.table is not None:
        lines += measured(pd.read_csv(asked.table))
    card = "\n".join(lines)
    with written_whole(WEIGHTS / "walk2d.md") as path:
        path.write_text(card + "\n", encoding="utf-8")
    print(card)


def listed(part: str, data: Path) -> list[str]:
    """Return the files of all clips, or the names of those of a part."""
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
    filming, found = Filming(), {}
    for seed, (part, of) in enumerate((("test", "held_out"), ("train", "learnt")), start=1):
        views = film_windows(
            clips[part], prior.skeleton, prior.fps, prior.frames, WINDOWS, seed=seed
        )
        found[of] = evaluator.features(views).astype(np.float16)
    held = io.BytesIO()
    np.savez_compressed(held, elevation=filming.elevation, distance=filming.distance, **found)
    with written_whole(WEIGHTS / f"{name}-features.npz") as path:
        path.write_bytes(held.getvalue())


def card_lines(prior: dict[str, Any], evaluator: dict[str, Any]) -> list[str]:
    """Return the model card: data, training and results."""
    size, data = prior["network"]["size"], prior["network"]["data"]
    lines = [
        "# walk2d",
        "",
        "People who walk, some of them stealthily, as one camera sees them: a 2D motion diffusion",
        "model (MAS, section 6.2) and the evaluator of its tables. Up to "
        f"{size['frames']} frames of {len(prior['network']['joint_names'])} joints at "
        f"{prior['network']['fps']:g} frames per second, the pelvis at the origin in every frame.",
        "",
        "- **Data**: 3D clips filmed by cameras around them (elevation "
        f"{math.degrees(Filming().elevation):.2f}° ± {math.degrees(Filming().tilt):.0f}°, 7 m) and",
        "  a detector with errors; only these pictures are learnt from. Learnt from: "
        f"{', '.join(data['clips'])} ({data['tracks']} tracks, {data['frames']} frames).",
        f"  The loss is watched on {', '.join(prior['network']['validation_data']['clips'])}.",
        f"  Held out: {', '.join(listed('test', Path()))}.",
        "- **Provenance**: humanoid3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng.",
        "  cmu_*: mocap.cs.cmu.edu, free for research and commercial use; the database was created",
        "  with funding from NSF EIA-0196217.",
        "- **Not for**: other actions, cameras far above or below, people who travel through the",
        "  picture; few bodies were learnt from, so proportions are theirs.",
        "",
        "| network | layers × width | steps | batch | seconds | loss | validation loss |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, card in (("prior", prior), ("evaluator", evaluator)):
        shape, last = card["network"]["size"], card["history"][-1]
        lines.append(
            f"| {name} | {shape['layers']} × {shape['width']} | {card['step']} "
            f"| {card['training']['batch']} | {card['seconds']:.0f} | {last['loss']:.4f} "
            f"| {last['validation_loss']:.4f} |"
        )
    return [
        *lines,
        "",
        "Seconds are of training steps on one thread of a shared CPU; no GPU was used. The",
        "validation loss is that of a body of which one other clip was learnt from. Commands:",
        "",
        *(f"    {line}" for line in COMMANDS),
    ]


def measured(table: pd.DataFrame) -> list[str]:
    """Return the rows of the ablation's table that concern the prior."""
    columns = ("fid_learnt", "precision_learnt", "recall_learnt", "fid", "to_real_mm")
    lines = [
        "",
        "Measured by `python notebooks/ablations/mas.py` (± over halves of the draws and sides):",
        "",
        "| | FID, learnt clips | P | R | FID, held-out clips | 3D to held-out, mm |",
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
