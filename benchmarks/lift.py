"""Speed and memory of ``lift`` on a minute of made video, as ``name: value`` lines."""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

from probmotion import save
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.lifting import lift

SECONDS, FPS = 60, 30.0


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
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"lift_peak_gib: {peak / (2**30 if sys.platform == 'darwin' else 2**20):.2f}")


if __name__ == "__main__":
    main()
