"""Periodic motion: the simulation of Latt et al. 2011, and real recordings that were clipped in software.

    python scripts/periodic_tables.py [simulation] [tremor] [arm] [board] [-o results/periodic] [--data DIR]

Each part writes a table (CSV) and figures; `board` makes board.json, board.md and env.json of the tables. Without
a name, all of them run, in this order.
"""

import argparse
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pandas as pd
from scipy import signal
from scipy.interpolate import CubicSpline

from jaxsat.inertial.filters import apply, butterworth, response
from jaxsat.inertial.harmonic import Spectrum, least_squares, predict, recursive
from jaxsat.inertial.periodic import analytical, band, chain_response, compensated, latt_bmflc, phases
from jaxsat.saturation.harmonic_fill import fill_harmonic
from jaxsat.signals.readers import read
from jaxsat.studies.boards import Row, write_board

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs" / "periodic"
UNIT = {2: 1e6, 1: 1e3}  # µm and mrad
NAMES = {2: "position", 1: "angle"}
PAPER = {  # RMS and maximum of the method and of analytical integration, without and with the sensor's filter
    (2, False): ((6.2, 23.1), (14.8, 43.6)),
    (2, True): ((6.5, 23.6), (24.1, 65.1)),
    (1, False): ((0.54, 1.78), (1.00, 2.92)),
    (1, True): ((0.56, 2.03), (1.64, 4.45)),
}


def settings(name: str) -> dict[str, Any]:
    return tomllib.loads((CONFIGS / f"{name}.toml").read_text())


@partial(jax.jit, static_argnames=("order", "samples"))
def simulated(key, config, rate, order, lowpass, samples):
    """Time, what the sensor reads, and the true motion."""
    time = jnp.arange(samples) / rate
    omega = 2 * jnp.pi * config["frequencies"]
    angle = time[:, None] * omega
    shape = -jnp.sin(angle) / omega**2 if order == 2 else -jnp.cos(angle) / omega
    read_out = config["amplitude"] * jnp.sin(angle).sum(axis=1) + config["offset"]
    read_out = read_out + config["noise"] * jax.random.normal(key, time.shape)
    for stage in lowpass:
        read_out = apply(stage, read_out)
    return time, read_out, config["amplitude"] * shape.sum(axis=1)


@partial(jax.jit, static_argnames=("order", "samples"))
def errors(key, config, rate, order, mu, frequency, highpass, lowpass, samples):
    """Error of every method at each sample."""
    time, read_out, truth = simulated(key, config, rate, order, lowpass, samples)
    by_analysis = analytical(read_out, time, frequency, order, mu).motion
    gain = chain_response(lowpass, order, frequency)
    angle = phases(frequency, time)
    offset = jnp.ones((samples, 1))
    x = jnp.concatenate([compensated(angle, jnp.ones_like(gain)), offset], axis=1)
    z = jnp.concatenate([compensated(angle, gain), 0 * offset], axis=1)
    # Nothing is known beforehand: sines of up to ten times the signal, an offset of up to 100 m/s².
    weights = 2 * len(frequency)
    prior = jnp.concatenate([jnp.full(weights, 4.0), jnp.full(1, 1e4)])
    spectrum = Spectrum(prior, config["noise"] ** 2)
    everywhere = jnp.ones(samples)
    paper = latt_bmflc(read_out, time, frequency, order, highpass, lowpass, mu)
    ignored = latt_bmflc(read_out, time, frequency, order, highpass, (), mu)
    tracked = recursive(read_out, everywhere, x, z, spectrum, jnp.zeros(weights + 1))
    at_once, _ = predict(least_squares(read_out, everywhere, x, spectrum), z)
    found = {
        "modified BMFLC": paper.motion,
        "without compensation": ignored.seen,
        "analytical": by_analysis,
        "analytical, one sample late": jnp.roll(by_analysis, 1),
        "recursive least squares": tracked.motion,
        "least squares": at_once,
    }
    return {name: motion - truth for name, motion in found.items()}


def scores(config: dict[str, Any], rate: float, order: int, filtered: bool, mu: float) -> list[dict[str, Any]]:
    """Median over the seeds of RMS and maximum error, for each method."""
    samples = round(config["duration"] * rate)
    numbers = {key: jnp.asarray(config[key]) for key in ("amplitude", "noise", "offset", "frequencies")}
    highpass = butterworth("highpass", 4, config["highpass"], rate)
    lowpass = (butterworth("lowpass", 1, config["lowpass"], rate),) if filtered else ()
    frequency = jnp.asarray(band(*config["band"]))
    scored = jnp.arange(samples) >= config["settle"] * rate

    def one(key):
        found = errors(key, numbers, rate, order, mu, frequency, highpass, lowpass, samples)
        rms = {name: jnp.sqrt(jnp.sum(scored * e**2) / scored.sum()) for name, e in found.items()}
        return rms, {name: jnp.max(scored * jnp.abs(e)) for name, e in found.items()}

    rms, largest = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(2011), config["seeds"]))
    unit = UNIT[order]
    return [
        {
            "motion": NAMES[order], "rate": rate, "sensor_filter": filtered, "mu": mu, "method": name,
            "rms": float(jnp.median(rms[name])) * unit, "max": float(jnp.median(largest[name])) * unit,
        }
        for name in rms
    ]  # fmt: skip


def simulation(out: Path) -> None:
    config = settings("simulation")
    rows = []
    for rate in config["rates"]:
        for order in (2, 1):
            for filtered in (False, True):
                for mu in config["mus"] if order == 2 and rate == config["rates"][0] else [config["mu"]]:
                    rows += scores(config, rate, order, filtered, mu)
                print(rate, NAMES[order], filtered, flush=True)
    pd.DataFrame(rows).to_csv(out / "simulation.csv", index=False, float_format="%.5g")
    figures(config, out)


def figures(config: dict[str, Any], out: Path) -> None:
    """The figures of the paper's Section 3, redrawn from one seed."""
    rate = config["rates"][0]
    samples = round(config["duration"] * rate)
    numbers = {key: jnp.asarray(config[key]) for key in ("amplitude", "noise", "offset", "frequencies")}
    highpass = butterworth("highpass", 4, config["highpass"], rate)
    lowpass = butterworth("lowpass", 1, config["lowpass"], rate)
    key = jax.random.key(2011)

    axes = np.linspace(8, 12, 200)
    figure, panels = plt.subplots(2, 2, figsize=(9, 5), sharex=True)
    for column, (name, stage) in zip(panels.T, {"low-pass 50 Hz": lowpass, "high-pass 5 Hz": highpass}.items(),
                                     strict=True):  # fmt: skip
        gain = np.asarray(response((stage,), jnp.asarray(axes)))
        column[0].plot(axes, np.abs(gain))
        column[0].set(title=name, ylabel="gain")
        column[1].plot(axes, np.rad2deg(np.angle(gain)))
        column[1].set(xlabel="frequency (Hz)", ylabel="phase (°)")
    save(figure, out / "filters.svg")

    time, read_out, truth = simulated(key, numbers, rate, 2, (), samples)
    figure, panels = plt.subplots(1, 2, figsize=(10, 3))
    panels[0].plot(time, 1e3 * read_out, lw=0.4)
    panels[0].set(xlabel="time (s)", ylabel="mm/s²", title="simulated acceleration")
    drifted = np.cumsum(np.cumsum(read_out)) / rate**2
    panels[1].plot(time, 1e3 * drifted, label="double integration")
    panels[1].plot(time, 1e3 * truth, label="true")
    panels[1].set(xlabel="time (s)", ylabel="mm", title="position")
    panels[1].legend()
    save(figure, out / "drift.svg")

    frequency = jnp.asarray(band(*config["band"]))
    figure, panels = plt.subplots(2, 2, figsize=(11, 6), sharex=True)
    for row, order in zip(panels, (2, 1), strict=True):
        found = errors(key, numbers, rate, order, config["mu"], frequency, highpass, (lowpass,), samples)
        seen = np.asarray(time) >= config["duration"] - 1
        _, _, true = simulated(key, numbers, rate, order, (lowpass,), samples)
        unit, name = UNIT[order], {2: "µm", 1: "mrad"}[order]
        row[0].plot(time[seen], unit * true[seen], "k", lw=2, alpha=0.4, label="true")
        for method in ("without compensation", "modified BMFLC"):
            row[0].plot(time[seen], unit * (true + found[method])[seen], lw=1, label=method)
        row[0].set(ylabel=f"{NAMES[order]} ({name})")
        for method in ("analytical", "modified BMFLC", "least squares"):
            row[1].plot(time[seen], unit * found[method][seen], lw=1, label=method)
        row[1].set(ylabel=f"error ({name})")
    for panel in panels[0]:
        panel.legend(fontsize=7, loc="upper right")
    for panel in panels[1]:
        panel.set_xlabel("time (s)")
    save(figure, out / "errors.svg")


def save(figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def clipped_and_filled(true: np.ndarray, share: float, missing: np.ndarray | None = None) -> dict[str, Any]:
    """Error in the gaps of a clipped copy: filled by harmonics, by a cubic spline, and left as it is."""
    low, high = np.quantile(true, [share / 2, 1 - share / 2])
    sign = (true >= high).astype(int) - (true <= low).astype(int)
    missing = np.zeros(len(true), bool) if missing is None else missing
    sign[missing] = 0
    measured = (sign == 0) & ~missing
    found = fill_harmonic(np.clip(true, low, high), sign, missing)
    index = np.arange(len(true))
    spline = CubicSpline(index[measured], true[measured])(index)
    gap = sign != 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], gap.astype(int), [0]])))
    error = {
        "harmonic": found.signal, "spline": spline, "clipped": np.clip(true, low, high),
    }  # fmt: skip
    error = {name: float(np.sqrt(np.mean((x - true)[gap] ** 2))) for name, x in error.items()}
    inside = np.abs(found.signal - true)[gap] < 1.96 * found.sd[gap]
    return {
        "share": share, "samples": int(gap.sum()), "gaps": len(edges) // 2,
        "longest": int(np.diff(edges)[::2].max()), **error, "ratio": error["harmonic"] / error["spline"],
        "cover95": float(inside.mean()),
    }  # fmt: skip


def tremor(out: Path, data: Path) -> None:
    config = settings("tremor")
    rows = []
    for path in sorted((data / "tremor").glob("*.csv")):
        recording = read(path)
        sections = signal.butter(4, config["drift_below"], "highpass", fs=1 / recording.period, output="sos")
        acc = recording.acc[recording.time >= recording.time[0] + config["seconds_dropped"]]
        name = "_".join(path.stem.removeprefix("T_").split("_")[:2]).lower() + ("_right" if "RIGHT" in path.stem else "")
        for axis, true in zip("xyz", signal.sosfiltfilt(sections, acc, axis=0).T, strict=True):
            for share in config["shares"]:
                rows.append({"recording": name, "channel": f"acc_{axis}", **clipped_and_filled(true, share)})
                print(rows[-1], flush=True)
    pd.DataFrame(rows).to_csv(out / "tremor.csv", index=False, float_format="%.4g")


def main() -> None:
    parser = argparse.ArgumentParser(description="Periodic motion")
    parser.add_argument("parts", nargs="*", default=[])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "results" / "periodic")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    arguments = parser.parse_args()
    out = arguments.output
    out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    parts = arguments.parts or ["simulation", "tremor", "arm", "board"]
    if "simulation" in parts:
        simulation(out)
    if "tremor" in parts:
        tremor(out, arguments.data)


if __name__ == "__main__":
    main()
