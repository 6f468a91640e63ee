"""Time and memory of `direct` on a long simulated walk: 30 minutes at 200 Hz against an eighth of it.

    python scripts/long_recording.py [-o results/long]

Each length runs in a process of its own, after a short one that compiles; writes board.json and env.json.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path


def run(minutes: float) -> dict:
    """Peak memory (bytes) and seconds of one estimate in this process; a first one compiles."""
    import jax

    from jaxsat import Config, Sensor, estimate, simulate
    from jaxsat.config import load_config
    from jaxsat.studies.motions import Walk

    settings: Config = load_config(None, **{"rails.gyr": 6.0, "saturation.gyr_bound": 4.0})
    probe, full = 15.0, 60.0 * minutes
    seconds = 0.0
    samples = saturated = 0
    for duration in (probe, full):
        motion = Walk(strides=int((duration - 2.0) / 1.1))
        recording, _ = simulate(
            motion, rate=200.0, duration=duration, sensor=Sensor(gyr_rail=6.0), key=jax.random.key(0)
        )
        start = time.perf_counter()
        found = estimate(recording, settings)
        seconds = time.perf_counter() - start
        samples, saturated = len(recording), int(found.saturated.sum())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"samples": samples, "saturated": saturated, "seconds": seconds, "peak_bytes": peak}


def main() -> None:
    parser = argparse.ArgumentParser(description="Time and memory on a long recording")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/long"))
    parser.add_argument("--minutes", type=float, help="measure this length only and print it")
    arguments = parser.parse_args()
    if arguments.minutes is not None:
        print(json.dumps(run(arguments.minutes)))
        return
    found = []
    for minutes in (3.75, 30.0):
        command = [sys.executable, __file__, "--minutes", str(minutes)]
        found.append(
            json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout.splitlines()[-1])
        )
        print(found[-1], flush=True)
    short, long = found
    board = [
        {
            "metric": "long_peak_bytes",
            "value": long["peak_bytes"],
            "unit": "B",
            "direction": "lower",
            "goal": 4e9,
            "baseline": None,
            "note": f"{long['samples']} samples, {long['saturated']} saturated values, method direct",
        },
        {
            "metric": "long_growth",
            "value": long["seconds"] / short["seconds"],
            "unit": "1",
            "direction": "lower",
            "goal": 9.0,
            "baseline": None,
            "note": f"time(8N)/time(N): {short['seconds']:.1f} s and {long['seconds']:.1f} s, compiled before",
        },
    ]
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
