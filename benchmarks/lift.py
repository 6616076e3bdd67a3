"""Speed and memory of ``lift`` on made video, as ``name: value`` lines.

Seconds and the size of the page are of one minute. Ten minutes are the keypoints of this minute,
ten times.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion import save
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.lifting import lift

SECONDS, FPS = 60, 30.0
TIMES = 10


def main() -> None:
    """Print every measurement."""
    clip = make_gait("march", frames=round(SECONDS * FPS), fps=FPS)
    video = film(clip, 0, azimuth=0.5)
    start = time.perf_counter()
    result = lift(video.track, image_size=video.size, progress=False)
    seconds = time.perf_counter() - start
    print(f"lift_seconds_per_second_of_video: {seconds / SECONDS:.3g}", flush=True)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        save(result.mean, Path(folder) / "lift.glb")
        print(f"export_glb_seconds: {time.perf_counter() - start:.3g}")
        page = result.report(Path(folder) / "lift.html")
        print(f"lift_page_megabytes: {page.stat().st_size / 1e6:.2g}")
    print(f"lift_peak_gib: {peak_gib():.2f}", flush=True)
    minute = video.track
    long = replace(
        minute,
        keypoints=np.tile(minute.keypoints, (TIMES, 1, 1)),
        confidence=np.tile(minute.confidence, (TIMES, 1)),
    )
    lift(long, image_size=video.size, progress=False)
    print(f"lift_peak_gib_ten_minutes: {peak_gib():.2f}")


def peak_gib() -> float:
    """Return the largest memory of this process until now, GiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**30 if sys.platform == "darwin" else 2**20)


if __name__ == "__main__":
    main()
