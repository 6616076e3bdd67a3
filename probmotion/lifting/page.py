"""Page of a lift: summary, keypoints, and draws in motion. It is self-contained."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem
from probmotion.geometry.cameras import Cameras
from probmotion.lifting.checks import Check
from probmotion.lifting.keypoints import from_hips
from probmotion.motion.motion import Motion
from probmotion.plots.animation import animated_page, animation_html
from probmotion.plots.motion_data import Shown

__all__ = ["lift_page"]

_DRAWS = 24  # draws from which the page computes standard deviations
_FRAMES = 450  # most frames of the animation
_STYLE = """
body { margin: 0 auto; max-width: 60rem; padding: 1rem; font: 1rem/1.5 system-ui, sans-serif;
  color: #222; background: #fff; --ink: #222; --quiet: #666; }
h1 { font-size: 1.4rem; } .quiet { color: #666; }
.bad { border-left: .4rem solid #c00; padding-left: .8rem; }
.good { border-left: .4rem solid #0a7d33; padding-left: .8rem; }
table { border-collapse: collapse; } td, th { padding: .15rem .8rem .15rem 0; text-align: left; }
.cards { grid-template-columns: minmax(0, 24rem); justify-content: center; }
td:last-child { overflow-wrap: anywhere; }
@media (max-width: 30rem) { td, th { padding-right: .4rem; font-size: .85rem; } }
td:nth-child(n + 2) { font-variant-numeric: tabular-nums; }
"""


def lift_page(
    motion: Motion,
    draws: np.ndarray,
    cameras: Cameras,
    camera_names: Sequence[str],
    keypoints: np.ndarray,
    checks: Sequence[Check],
    sentences: Sequence[str],
) -> str:
    """Return the page as HTML.

    Parameters
    ----------
    motion : Motion
        Posterior mean.
    draws : ndarray, (n, L, J, 3)
        Posterior draws, metres.
    cameras : Cameras
        The V cameras; the animation shows the view with the most keypoints.
    camera_names : sequence of str
        Names of calibrated cameras; empty without a calibration.
    keypoints : ndarray, (V, L, J, 2)
        Keypoints, pixels; NaN where missing.
    checks : sequence of Check
    sentences : sequence of str
        Summary.
    """
    name = motion.name or "motion"
    step = max(1, -(-motion.frames // _FRAMES))
    # Spread about common hips: the distance from the camera would hide that of the pose.
    place = motion.positions - from_hips(motion.positions)
    shown_draws = from_hips(draws[:_DRAWS]) + place
    view = int(np.isfinite(keypoints).sum(axis=(1, 2, 3)).argmax())
    problem = StoredProblem(
        motion.skeleton, motion.fps, True, camera=cameras.view(view), keypoints=keypoints[view]
    )
    rows = {"lift": np.concatenate([motion.positions[None], shown_draws])}
    shown = Shown(problem, rows, step, overlaid=True, floor=0.0)
    caption = (
        f"mean and {min(3, len(draws))} draws; joints coloured by the standard deviation of "
        f"{len(shown_draws)} draws"
    )
    if cameras.n_views > 1:
        caption += f"; the camera’s view and keypoints are those of {camera_names[view]}"
    animation = animation_html(name, shown, {"lift": caption})
    table = "\n".join(
        f"<tr><td>{escape(check.name)}</td><td>{check.value:.3g}</td><td>{check.limit:.3g}</td>"
        f"<td>{'passed' if check.passed else escape(check.problem)}</td></tr>"
        for check in checks
    )
    mark = "good" if all(check.passed for check in checks) else "bad"
    summary = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
    count = "one camera" if cameras.n_views == 1 else f"{cameras.n_views} cameras"
    title = f"{motion.name}: 3D motion from {count}".removeprefix(": ")
    body = f"""\
<h1>{escape(title)}</h1>
<div class="{mark}">{summary}</div>
{animation}
<h2>Checks</h2>
<table>
<tr><th>check</th><th>value</th><th>at most</th><th>result</th></tr>
{table}
</table>"""
    return animated_page(title, body, _STYLE)
