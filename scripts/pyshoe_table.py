"""Position error of every method on real saturated foot recordings, against Vicon.

    python scripts/pyshoe_table.py ../shared/data/pyshoe [--list saturated] [-o results/pyshoe]

Recordings: PyShoe Vicon set (Wagstaff, Peretroukhin, Kelly 2019, IEEE DataPort 10.21227/v1z6-9z84). Rests are the
set's own flags (`zv_shoe_opt`); the trajectory is aligned to Vicon by yaw and translation. Writes table.csv,
README.md and env.json.
"""

import argparse
import json
import platform
import tomllib
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from jaxsat.config import load_config
from jaxsat.pipeline import estimate
from jaxsat.signals.readers import read
from jaxsat.studies.metrics import load_pyshoe_truth, position_rmse, pyshoe_error

METHODS = ("standard", "direct", "triangle", "quadratic")


def score(path: Path) -> list[dict]:
    """One row a method."""
    recording = read(path, rest_column="zv_shoe_opt")
    _, truth = load_pyshoe_truth(path, at=recording.time)
    rows = []
    for method in METHODS:
        found = estimate(recording, load_config(None, method=method))
        position = found.trajectory.position
        rows.append(
            {
                "trial": path.stem,
                "method": method,
                "saturated": int(found.saturated.sum()),
                "gaps": len(found.gaps),
                "rmse_3d": position_rmse(position, truth),
                "rmse_2d": position_rmse(position, truth, axes=2),
                "pyshoe_3d": pyshoe_error(position, truth),
                "cost": float(found.cost),
                "not_converged": int((found.fills.status == 1).sum()),
                "at_bound": int(found.fills.at_bound.sum()),
                "seconds": round(sum(found.seconds.values()), 1),
            }
        )
        print(path.stem, method, *(f"{rows[-1][k]:.3f}" for k in ("rmse_3d", "rmse_2d")), flush=True)
    return rows


def page(table: pd.DataFrame, trials: str) -> str:
    """The table for people."""
    lines = [
        "# Real saturation: PyShoe Vicon trials",
        "",
        f"Trials of the list `{trials}`; position RMSE against Vicon in m, yaw and translation aligned,",
        "3D / 2D. Rests as given (`zv_shoe_opt`), rails and everything else found in the recording; default",
        "configuration. Made by `scripts/pyshoe_table.py`; all columns are in `table.csv`.",
        "",
        "| trial | saturated values | " + " | ".join(METHODS) + " |",
        "|---|---:|" + "---:|" * len(METHODS),
    ]
    wide = table.pivot(index="trial", columns="method", values=["rmse_3d", "rmse_2d"])
    counts = table.groupby("trial")["saturated"].first()
    for trial in wide.index:
        cells = [f"{wide['rmse_3d'][m][trial]:.3f} / {wide['rmse_2d'][m][trial]:.3f}" for m in METHODS]
        lines.append(f"| {trial} | {counts[trial]} | " + " | ".join(cells) + " |")
    means = [f"{wide['rmse_3d'][m].mean():.3f} / {wide['rmse_2d'][m].mean():.3f}" for m in METHODS]
    lines.append("| **mean** | | " + " | ".join(means) + " |")
    ratios, worst = [], []
    for m in METHODS:
        ratio = [wide[k][m] / wide[k]["standard"] for k in ("rmse_3d", "rmse_2d")]
        ratios.append(" / ".join(f"{np.exp(np.log(r).mean()):.2f}" for r in ratio))
        worst.append(" / ".join(f"{r.max():.2f}" for r in ratio))
    lines.append("| **ratio to standard, geometric mean** | | " + " | ".join(ratios) + " |")
    lines.append("| **ratio to standard, worst trial** | | " + " | ".join(worst) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description="Position errors on the PyShoe set")
    parser.add_argument("folder", type=Path, help="folder with the PyShoe .mat files and splits.toml")
    parser.add_argument("--list", default="saturated", help="list of splits.toml")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/pyshoe"))
    arguments = parser.parse_args()
    names = tomllib.loads((arguments.folder / "splits.toml").read_text())[arguments.list]
    rows = [row for name in names for row in score(arguments.folder / f"{name}.mat")]
    table = pd.DataFrame(rows)
    arguments.output.mkdir(parents=True, exist_ok=True)
    table.round(6).to_csv(arguments.output / "table.csv", index=False)
    (arguments.output / "README.md").write_text(page(table, arguments.list))
    packages = ("jaxsat", "jax", "jaxopt", "optax", "equinox", "numpy")
    environment = {
        "list": arguments.list,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "versions": {name: version(name) for name in packages},
        "configuration": load_config(None).model_dump(),
    }
    (arguments.output / "env.json").write_text(json.dumps(environment, indent=2) + "\n")
    print(page(table, arguments.list))


if __name__ == "__main__":
    main()
