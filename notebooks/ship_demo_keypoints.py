"""Write the keypoints that ``make demo`` lifts: a made video of a person who walks for 2.5 s.

python notebooks/ship_demo_keypoints.py       # writes notebooks/keypoints/walk.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film

PATH = Path(__file__).parent / "keypoints" / "walk.json"


def main() -> None:
    """Write the file, in the format of rtmlib: keypoints and scores of every frame."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    track = film(make_gait("walk", 3, frames=75), 0, azimuth=0.8, height=1.4).track
    points = np.nan_to_num(track.keypoints).round(1)
    frames = [
        {"keypoints": [rows.tolist()], "scores": [scores.tolist()]}
        for rows, scores in zip(points, track.confidence, strict=True)
    ]
    lines = ",\n".join(json.dumps(frame, separators=(",", ":")) for frame in frames)
    PATH.parent.mkdir(exist_ok=True)
    PATH.write_text(f'{{"fps": {track.fps:g}, "frames": [\n{lines}\n]}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
