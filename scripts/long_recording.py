"""Time and memory of `direct` and `map` on a long simulated walk: 30 minutes at 200 Hz against an eighth of it.

    python scripts/long_recording.py [-o results/long]

Each length runs in a process of its own, twice, since the first one compiles; writes board.json and env.json.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path


def run(method: str, minutes: float) -> dict:
    """Peak memory (bytes) of this process and seconds of one estimate in it; a first one compiles."""
    import jax

    from jaxsat import Config, Sensor, estimate, simulate
    from jaxsat.config import load_config
    from jaxsat.studies.motions import Walk

    chosen = {"rails.gyr": 6.0, "saturation.gyr_bound": 4.0}
    settings: Config = load_config(None, method=method, **chosen)
    motion = Walk(strides=int((60.0 * minutes - 2.0) / 1.1))
    recording, _ = simulate(
        motion, rate=200.0, duration=60.0 * minutes, sensor=Sensor(gyr_rail=6.0), key=jax.random.key(0)
    )
    estimate(recording, settings)
    start = time.perf_counter()
    found = estimate(recording, settings)
    seconds = time.perf_counter() - start
    # `getrusage` would count the process that started this one.
    peak = 1024 * int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
    saturated = int(found.saturated.sum())
    return {"samples": len(recording), "saturated": saturated, "seconds": seconds, "peak_bytes": peak}


def rows(method: str) -> list[dict]:
    """Of the board: peak memory of the long recording, and how time grows."""
    found = []
    for minutes in ("3.75", "30"):
        command = [sys.executable, __file__, "--one", method, minutes]
        found.append(
            json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout.splitlines()[-1])
        )
        print(method, found[-1], flush=True)
    short, long = found
    return [
        {
            "metric": f"{method}_peak_bytes",
            "value": long["peak_bytes"],
            "unit": "B",
            "direction": "lower",
            "goal": 4e9,
            "baseline": None,
            "note": f"{long['samples']} samples, {long['saturated']} saturated values",
        },
        {
            "metric": f"{method}_growth",
            "value": long["seconds"] / short["seconds"],
            "unit": "1",
            "direction": "lower",
            "goal": 9.0,
            "baseline": None,
            "note": f"time(8N)/time(N): {short['seconds']:.1f} s and {long['seconds']:.1f} s, compiled before",
        },
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Time and memory on a long recording")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/long"))
    parser.add_argument(
        "--one", nargs=2, metavar=("METHOD", "MINUTES"), help="measure this only and print it"
    )
    arguments = parser.parse_args()
    if arguments.one is not None:
        method, minutes = arguments.one
        print(json.dumps(run(method, float(minutes))))
        return
    board = [row for method in ("direct", "map") for row in rows(method)]
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "board.json").write_text(json.dumps(board, indent=2) + "\n")
    environment = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("jaxsat", "jax", "jaxopt")},
    }
    (arguments.output / "env.json").write_text(json.dumps(environment, indent=2) + "\n")


if __name__ == "__main__":
    main()
