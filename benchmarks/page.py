"""Run the benchmarks of speed and memory, and write the page of the documentation with them.

With arguments, only these scripts run, and the rows of the others are kept.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
PAGE = FOLDER.parent / "docs" / "developer" / "benchmarks.md"
PRODUCTS = "1: the processor's rate in large matrix products"
IN_DENSITIES = "at least 0.9; 1: all time in densities"
IN_NETWORK = "at most 0.02; 0: all time in the network"
# Measurements to show, with a goal of the project ("at least", "at most") or a peer.
BENCHMARKS: dict[str, dict[str, str]] = {
    "front_door.py --parts demo score": {
        "demo_seconds": "",
        "page_megabytes": "",
        "score_seconds": "",
    },
    "overhead.py": {
        "import_seconds": "at most 0.3",
        "nuts_ratio": "1: NumPyro called directly",
        "ensemble_ratio": "1: emcee called directly",
        "tempered_density_fraction_gait_monocular": IN_DENSITIES,
        "smc_density_fraction_gait_monocular": IN_DENSITIES,
        "tempered_density_fraction_gait_noisy3d": IN_DENSITIES,
        "smc_density_fraction_gait_noisy3d": IN_DENSITIES,
        "tempered_density_fraction_walk_vae_monocular": IN_DENSITIES,
        "smc_density_fraction_walk_vae_monocular": IN_DENSITIES,
        "mas_denoiser_share": "1: all time in the denoiser",
        "mas_1000_draws_gib": "",
    },
    "compare.py": {"efficiency_two_workers": "at least 0.92"},
    "streaming.py": {
        "stream_overhead_mh": "at most 1.05; 1: the same run in memory",
        "stream_overhead_nuts": "at most 1.05; 1: the same run in memory",
        "stream_overhead_ancestral3d": "at most 1.05; 1: the same run in memory",
        "stream_peak_gib": "at most 1.5",
    },
    "exact_denoiser.py": {
        "evaluations_per_second": "at least 100 000",
        "full_size_evaluations_per_second": "",
    },
    "triangulate.py": {
        "milliseconds": "at most 0.5",
        "speed_ratio_to_adam": "1: Adam in PyTorch, as in the code of the authors of MAS",
    },
    "exact_priors.py": {
        "fit_seconds_per_hour": "at most 60",
        "posterior_ms_per_frame_60": "at most 2",
        "posterior_ms_per_frame_6000": "at most 2",
        "denoiser_per_second": "at least 5 000",
        "em_lift_per_second": "at least 2 000",
        "peak_gib": "",
    },
    "lift.py": {
        "lift_seconds_per_second_of_video": "at most 0.5; 1: real time",
        "export_glb_seconds": "at most 2",
        "lift_page_megabytes": "at most 5",
        "lift_peak_gib": "at most 2",
        "lift_peak_gib_ten_minutes": "at most 2",
    },
    "images.py": {
        "renders_per_second_128": "at least 8",
        "mitsuba_renders_per_second_128": "",
        "encoder_milliseconds": "at most 50",
        "reconstruct_seconds": "at most 20",
        "clip_seconds": "",
        "peak_gib": "at most 3",
    },
    "pose_pairs.py": {
        "single_view_proposals_per_second": "at least 15 000",
        "full_density_ms": "at most 1.2",
        "full_density_batch_ms": "at most 0.6",
        "full_proposals_per_second": "at least 3 000",
        "draws_per_second": "10: the published system, on four cores",
        "ess_per_second": "",
        "memory_gib": "",
    },
    "mas.py": {
        "outside_network_share": IN_NETWORK,
        "outside_network_share_ddim": IN_NETWORK,
        "outside_network_share_second_order_sde": IN_NETWORK,
        "outside_network_share_heun": IN_NETWORK,
        "network_gflops_share": f"at least 0.7; {PRODUCTS}",
        "split_gibbs_evaluations_per_draw": "",
        "memory_gib": "",
        "strided_20_fid_ratio": "1: 100 steps instead of 20",
    },
    "motion_dvae.py": {
        "regression_seconds_per_frame": "",
        "optimization_seconds_per_frame": "",
        "batch_throughput_ratio": "1: one sequence at a time",
        "memory_gib": "",
    },
    "motion_vae.py": {
        "generation_seconds": "",
        "training_step_seconds": "",
        "training_step_share_of_products": PRODUCTS,
        "memory_gib": "",
    },
}
HEAD = """# Benchmarks

Speed and memory, measured by `make bench` on {machine}.
What a number means is in the first lines of its script. Accuracy is in the studies and guides.

*One run of every script. Goal: a bound that the project sets itself. Peer: what a ratio or rate is
relative to, on the same machine unless stated.*

| Measurement | Value | Goal or peer | Command | Date |
|---|---|---|---|---|
"""


def main() -> int:
    """Run the scripts and write the page after each; return 1 if one failed, else 0."""
    names = {command.partition(" ")[0]: command for command in BENCHMARKS}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scripts", nargs="*", metavar="script", help=f"Of {', '.join(names)}.")
    chosen = parser.parse_args().scripts or list(names)
    if unknown := set(chosen) - set(names):
        parser.error(f"scripts must be among {', '.join(names)}, got {', '.join(unknown)}")
    # Rows of another machine are not comparable.
    text = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    rows = rows_of(text) if f" on {machine()}.\n" in text else {}
    failed = []
    for script in chosen:
        command = names[script]
        print(f"# {command}", flush=True)
        try:
            rows[command] = measured(command)
        except (subprocess.CalledProcessError, KeyError) as error:
            print(f"{command} failed: {error}", file=sys.stderr)
            failed.append(command)
        ordered = [line for command in BENCHMARKS for line in rows.get(command, [])]
        PAGE.write_text(HEAD.format(machine=machine()) + "".join(ordered), encoding="utf-8")
    return bool(failed)


def machine() -> str:
    """Return the number of cores and the processor."""
    lines = Path("/proc/cpuinfo")
    text = lines.read_text(encoding="utf-8") if lines.exists() else ""
    found = dict(re.findall(r"^(model name|cpu family|model)\s*: (.*)$", text, re.MULTILINE))
    name = found.get("model name") or platform.processor() or platform.machine()
    if "cpu family" in found:
        name += f" (family {found['cpu family']}, model {found['model']})"
    return f"{os.cpu_count()} cores of {name}"


def rows_of(page: str) -> dict[str, list[str]]:
    """Return the rows of a page by command."""
    rows: dict[str, list[str]] = {}
    for line in page.splitlines(keepends=True):
        if match := re.search(r"\| `python benchmarks/(.*)` \| [\d-]+ \|$", line):
            rows.setdefault(match[1], []).append(line)
    return rows


def measured(command: str) -> list[str]:
    """Run a script and return its rows; raise KeyError if it does not print a measurement."""
    words = command.split()
    line = [sys.executable, str(FOLDER / words[0]), *words[1:]]
    values = {}
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for printed in process.stdout:
            print(printed, end="", flush=True)
            if match := re.fullmatch(r"(\w+): (\S+)\n", printed):
                values[match[1]] = match[2]
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    today = datetime.date.today().isoformat()
    return [
        f"| `{name}` | {values[name]} | {goal} | `python benchmarks/{command}` | {today} |\n"
        for name, goal in BENCHMARKS[command].items()
    ]


if __name__ == "__main__":
    sys.exit(main())
