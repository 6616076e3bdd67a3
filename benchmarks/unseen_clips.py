"""Accuracy of lifts of clips that are left out of the training of prior and network.

    PYTHONPATH=notebooks python benchmarks/unseen_clips.py --data DATA --out runs/unseen \
        --clips running cmu_02_03

leaves out all clips whose names start with these, fits both from the others (25 minutes on one
thread; kept in ``--out``), and lifts made videos of these clips from eight directions. Prints
``name: value`` lines for clips of each name without its number: medians over videos, the mean
coverage, and how many lifts with errors below and above 100 mm the checks mark.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from functools import lru_cache, partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from lift_figures import FRAMES, GOOD, HEIGHTS, PERSON, VIEWS, errors, lifted
from ship_cmu_motion import COMPONENTS, joined, mirrored, recordings
from ship_pose_depth import examples, trained

from probmotion.data.videos import film
from probmotion.lifting import track_lift, windows
from probmotion.lifting.window_prior import WindowPrior
from probmotion.models import SpectralMixtureMotion
from probmotion.models.unseen_depth.pose_depth import PoseDepth
from probmotion.motion.motion import Motion
from probmotion.threads import one_thread


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="Folder of the recordings.")
    parser.add_argument(
        "--out", type=Path, required=True, help="Folder for the prior and the network."
    )
    parser.add_argument(
        "--clips", nargs="+", required=True, help="Starts of the names of clips that are left out."
    )
    options = parser.parse_args()
    names = tuple(options.clips)
    parts = recordings(options.data, partial(Motion.retarget, skeleton=PERSON))
    unseen = []
    for part in ("train", "actions"):
        unseen += [clip for clip in parts[part] if clip.name.startswith(names)]
        parts[part] = [clip for clip in parts[part] if not clip.name.startswith(names)]
    if not unseen:
        parser.error(f"clips must be starts of names of training clips, got {' '.join(names)}")
    with one_thread():
        fit(parts, sorted(clip.name for clip in unseen), options.out)
        rows = measured(unseen, options.out)
    for kind, values in rows.items():
        good = values[:, 0] <= GOOD
        print(f"unseen_{kind}_videos: {len(values)}")
        print(f"unseen_{kind}_mpjpe_mm: {np.median(values[:, 0]):.4g}")
        print(f"unseen_{kind}_coverage_90: {values[:, 1].mean():.4g}")
        print(f"unseen_{kind}_root_error: {np.median(values[:, 2]):.4g}")
        print(f"unseen_{kind}_flagged_good: {values[good, 3].sum():.0f} of {good.sum()}")
        print(f"unseen_{kind}_flagged_bad: {values[~good, 3].sum():.0f} of {(~good).sum()}")


def fit(parts: dict[str, list[Motion]], unseen: list[str], out: Path) -> None:
    """Write prior and network, unless they are there; an interrupted training is resumed."""
    out.mkdir(parents=True, exist_ok=True)
    names = out / "unseen.json"
    if names.exists() and json.loads(names.read_text(encoding="utf-8")) != unseen:
        raise SystemExit(
            f"out must be a folder in which the same clips are left out, got {out}; use another"
        )
    names.write_text(json.dumps(unseen), encoding="utf-8")
    if not (out / "prior.npz").exists():
        priors = []
        for part, count in zip(("train", "actions"), COMPONENTS["person14"], strict=True):
            both = [*parts[part], *map(mirrored, parts[part])]
            priors.append(SpectralMixtureMotion.fit(both, components=count))
        joined(priors).save(out / "prior.npz")
    if not (out / "depths.npz").exists():
        training = examples(parts["train"] + parts["actions"], vary=True)
        trained(training, parts["validation"], out / "run").save(out / "depths.npz")


def measured(clips: list[Motion], out: Path) -> dict[str, np.ndarray]:
    """Return each video's error (mm), coverage, error of the path, and whether it is marked.

    They are grouped by the names of the clips without their numbers.
    """
    network = PoseDepth.load(out / "depths.npz")
    prior = lru_cache(partial(WindowPrior, SpectralMixtureMotion.load(out / "prior.npz")))
    rows = defaultdict(list)
    with (
        patch.object(windows, "_prior", prior),
        patch.object(track_lift, "_regression", lambda: network),
    ):
        for number, clip in enumerate(clips):
            part = clip.window(0, min(FRAMES, clip.frames))
            for view in range(VIEWS):
                azimuth = (view + number) % VIEWS * 2 * np.pi / VIEWS
                video = film(part, number, azimuth=azimuth, height=HEIGHTS[view % 2])
                result = lifted(video)
                kind = clip.name.rstrip("0123456789_-")
                rows[kind].append((*errors(result, video), not result.trusted))
    return {kind: np.array(values, dtype=float) for kind, values in rows.items()}


if __name__ == "__main__":
    main()
