"""The tables and figures of Dang & Suh 2014, and what the paper does not have: all, or some by name.

    python scripts/reproduce_paper.py [NAME ...] [-o results/paper] [--data ../shared/data]

Each experiment has its settings in configs/paper/NAME.toml and writes table.csv, its figures (PNG and SVG) and
env.json (settings, versions, hardware, seconds) into a folder of its name. The board and the page are made anew
from all folders that are there.
"""

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path

import jax
from paper import drawn, page, searches, simulations, walks
from paper.trials import ROOT, Settings, settings

from jaxsat.cli.shared import use_compilation_cache
from jaxsat.errors import InputError
from jaxsat.studies.boards import machine, write_board

EXPERIMENTS = {
    "bar": simulations.table,
    "rail_direct": simulations.rail_sweep,
    "rail_shapes": simulations.rail_sweep,
    "bound": simulations.bound_sweep,
    "straight": simulations.table,
    "straight_even": simulations.table,
    "planar": simulations.table,
    "walk": walks.simulated,
    "walk_saturated": walks.saturated,
    "walk_clipped": walks.software,
    "segments": walks.orders,
    "coverage": searches.coverage,
    "coverage_drawn": partial(searches.coverage, trial=drawn.drawn),
    "iterations": searches.iterations,
    "starts": searches.starts,
    "eq21": searches.eq21,
}


def run(name: str, out: Path, data: Path, quick: bool = False) -> Settings:
    """Run one experiment into a folder of its name; returns its settings."""
    chosen, folder = settings(name, quick), out / name
    begin, worked = time.perf_counter(), time.process_time()
    folder.mkdir(parents=True, exist_ok=True)
    experiment = EXPERIMENTS[name]
    if name == "walk_saturated":
        experiment = partial(experiment, data=data)
    with jax.enable_x64(True):
        experiment(chosen, folder)
    seconds, cpu = round(time.perf_counter() - begin, 1), round(time.process_time() - worked, 1)
    environment = {**machine(), "seconds": seconds, "cpu_seconds": cpu, "settings": chosen}
    (folder / "env.json").write_text(json.dumps(environment, indent=2, ensure_ascii=False) + "\n")
    print(f"{name}: {seconds} s ({cpu} s of processor time)", flush=True)
    return chosen


def main() -> int:
    parser = argparse.ArgumentParser(description="The tables and figures of Dang & Suh 2014")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(EXPERIMENTS))
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "results" / "paper")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in EXPERIMENTS]
    if unknown:
        raise InputError(f"no experiment '{unknown[0]}'; choose among {', '.join(EXPERIMENTS)}.")
    use_compilation_cache()
    for name in arguments.names or EXPERIMENTS:
        if name == "walk_saturated" and not (arguments.data / "pyshoe").is_dir():
            print(f"{name}: left out, there are no recordings at {arguments.data / 'pyshoe'}")
            continue
        run(name, arguments.output, arguments.data)
    done = {name: settings(name) for name in EXPERIMENTS if (arguments.output / name / "table.csv").exists()}
    write_board(arguments.output / "board.json", page.board(arguments.output, done), done)
    (arguments.output / "README.md").write_text(page.page(arguments.output, done))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(str(error))
