"""Recorded and synthetic clips of one person for training denoisers, split by clip."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from probmotion.data.person_clips import clip_segments, on_person
from probmotion.data.synthetic.gaits import GAITS, make_gait
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["DENOISING_CLIPS", "denoising_clips", "synthetic_denoising_clips"]

_FPS = 30.0
_HUMANOID_TRAINING = (
    "backflip", "cartwheel", "crawl", "dance_a", "dance_spin", "getup_facedown", "long_walk1",
    "long_walk2", "long_zombie", "punch", "roll", "sideflip", "spin", "spinkick", "stealthy_walk0",
)  # fmt: skip

DENOISING_CLIPS: Mapping[str, tuple[str, ...]] = {
    "train": (
        *(f"cmu_single/cmu_01_{trial:02}" for trial in (*range(1, 9), 10, 11, 12, 14)),
        *(f"cmu_single/cmu_02_{trial:02}" for trial in (1, 3, 4, 5, 6, 8, 10)),
        "cmu_single/cmu_131_01",
        *(f"deepmimic_human/humanoid3d_{name}" for name in _HUMANOID_TRAINING),
    ),
    "validation": (
        "cmu_single/cmu_01_09",
        "cmu_single/cmu_02_09",
        "deepmimic_human/humanoid3d_jump",
        "deepmimic_human/humanoid3d_stealthy_walk",
    ),
    "test": (
        *(f"cmu_single/cmu_{trial}" for trial in ("01_13", "02_02", "02_07", "131_02")),
        "deepmimic_human/humanoid3d_getup_faceup",
        "deepmimic_human/humanoid3d_long_walk3",
    ),
}
"""Clips by part of the split: 45 of the 48 clips of one person.

Five test clips resemble training clips: a climb, a walk, sword play, a dance and DeepMimic's walk.
The sixth, getting up from the back (``humanoid3d_getup_faceup``), does not. Three clips are
excluded: ``humanoid3d_walk`` and ``humanoid3d_zombie_walk`` are excerpts of other clips, and
``humanoid3d_jog`` is shorter than a window.
"""

_STYLES = tuple(style for style, gait in GAITS.items() if gait.body == "person")


def denoising_clips(
    folder: str | Path, convert: Callable[[Motion], Motion] | None = None
) -> dict[str, list[Motion]]:
    """Return the recorded clips of each part at 30 frames per second.

    ``folder`` contains the clips of :data:`DENOISING_CLIPS` as ``.npz``. ``convert`` converts
    recordings to the skeleton of the clips, by default ``person14``. A clip is split at frames
    marked as ``suspect`` in its file (marker jumps) into segments named ``cmu_01_07-0``, …. Raises
    ``FileNotFoundError`` if a file is missing, and ``ValueError`` if ``suspect`` is not one bool
    per frame.
    """
    convert = on_person if convert is None else convert
    return {
        part: [
            segment
            for name in names
            for segment in clip_segments(Path(folder) / f"{name}.npz", convert)
        ]
        for part, names in DENOISING_CLIPS.items()
    }


def synthetic_denoising_clips(
    n: int = 60, *, seconds: float = 4.0, seed: int = 0
) -> dict[str, list[Motion]]:
    """Return synthetic clips of people who walk, run or march, on ``person14`` at 30 fps.

    The training part has ``n`` clips of ``seconds`` s, validation and test n / 5 clips each, at
    least one per style.
    """
    check_count("n", n)
    check_positive("seconds", seconds)
    held_out = max(n // 5, len(_STYLES))
    skeleton = Skeleton.preset("person14")
    frames = max(round(seconds * _FPS), 1)
    clips = []
    for number in range(n + 2 * held_out):
        index, style = divmod(number, len(_STYLES))
        gait = make_gait(_STYLES[style], index, frames=frames, fps=_FPS, seed=seed)
        clips.append(gait.retarget(skeleton))
    end = n + held_out
    return {"train": clips[:n], "validation": clips[n:end], "test": clips[end:]}
