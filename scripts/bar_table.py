"""The bar simulation of Dang & Suh 2014 (Table 1): last-position error of every method over that of `standard`.

    python scripts/bar_table.py [-o results/bar] [--seeds 20]

Rail 7.5 rad/s of a peak of 11, δ_b = 5, 160 samples at 100 Hz, rests as they truly are; median over the seeds.
"""

import argparse
import json
import platform
from importlib.metadata import version
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

from jaxsat import Sensor, estimate, load_config, simulate
from jaxsat.studies.motions import Bar

PAPER = {"direct": 0.070, "triangle": 0.098, "quadratic": 0.079}
SETTINGS = {"saturation.gyr_bound": 5.0, "rails.gyr": 7.5}


def errors(method: str, seeds: int) -> np.ndarray:
    """Last-position error of each seed (m)."""
    found = []
    for seed in range(seeds):
        recording, truth = simulate(
            Bar(), rate=100.0, duration=1.6, sensor=Sensor(gyr_rail=7.5), key=jax.random.key(seed)
        )
        recording = eqx.tree_at(lambda r: r.rest, recording, truth.rest, is_leaf=lambda x: x is None)
        position = estimate(recording, load_config(None, method=method, **SETTINGS)).trajectory.position
        found.append(np.linalg.norm(position[-1] - truth.position[-1]))
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(description="Table 1 of Dang & Suh 2014")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/bar"))
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    standard = errors("standard", arguments.seeds)
    board = []
    for method, goal in PAPER.items():
        ratio = errors(method, arguments.seeds) / standard
        board.append(
            {
                "metric": f"bar_{method}",
                "value": float(np.median(ratio)),
                "unit": "1",
                "direction": "lower",
                "goal": goal,
                "baseline": None,
                "note": f"last-position error over that of standard ({np.median(standard):.3f} m), median of "
                f"{arguments.seeds} seeds, {ratio.min():.4f} to {ratio.max():.4f}; goal: the paper's ratio",
            }
        )
        print(method, board[-1]["value"], "paper", goal, flush=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "board.json").write_text(json.dumps(board, indent=2) + "\n")
    environment = {
        "machine": platform.machine(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("jaxsat", "jax", "jaxopt", "optax", "equinox")},
        "settings": SETTINGS,
    }
    (arguments.output / "env.json").write_text(json.dumps(environment, indent=2) + "\n")


if __name__ == "__main__":
    main()
