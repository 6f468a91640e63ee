"""What the spectrum alone can say of clipped tremor: fills that know the covariance of the unclipped recording.

    python scripts/periodic_bound.py ../shared/data [-o results/periodic/bound.csv]

The best linear interpolation from the unsaturated samples of a window, with the autocovariance of the whole unclipped
recording: of the clipped axis alone, and with the other two axes, clipped alike. What they leave, beside a cubic
spline, is what no fill by the spectrum can undercut unless it uses the side of the rail or local changes.
"""

import argparse
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy import signal
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_factor, cho_solve

from jaxsat.inertial.windows import Windows
from jaxsat.signals.readers import read

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "periodic" / "tremor.toml"
LENGTH = 256
# A covariance that is estimated of a finite recording is singular to rounding.
NUGGET = 1e-6


def covariance(x: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "CL CL"]:
    """Of C channels over LENGTH samples, channel after channel, stationary."""
    lag = np.subtract.outer(np.arange(LENGTH), np.arange(LENGTH))
    n = len(x)
    blocks = [[(signal.correlate(a, b, method="fft") / n)[n - 1 + lag] for b in x.T] for a in x.T]
    K = np.block(blocks)
    return K + NUGGET * np.trace(K) / len(K) * np.eye(len(K))


def interpolated(
    x: Float[np.ndarray, "N C"], known: Bool[np.ndarray, "N C"], K: Float[np.ndarray, "CL CL"]
) -> Float[np.ndarray, "N C"]:
    """The mean of what is not known given what is, in windows that are blended."""
    windows = Windows.cut(len(x), LENGTH)
    rows = []
    for index in windows.index:
        there, values = known[index].T.ravel(), x[index].T.ravel()
        mean = K[:, there] @ cho_solve(cho_factor(K[np.ix_(there, there)]), values[there])
        rows.append(np.where(there, values, mean).reshape(x.shape[1], LENGTH).T)
    return np.stack([windows.joined(np.array(rows)[:, :, c]) for c in range(x.shape[1])], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Bounds of filling tremor by its spectrum")
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/periodic/bound.csv"))
    arguments = parser.parse_args()
    config, rows = tomllib.loads(CONFIG.read_text()), []
    for path in sorted((arguments.data / "tremor").glob("*.csv")):
        recording = read(path)
        sections = signal.butter(4, config["drift_below"], "highpass", fs=1 / recording.period, output="sos")
        used = recording.time >= recording.time[0] + config["seconds_dropped"]
        true = signal.sosfiltfilt(sections, recording.acc[used], axis=0)
        for share in config["shares"]:
            low, high = np.quantile(true, [share / 2, 1 - share / 2], axis=0)
            cut = np.clip(true, low, high)
            known, sign = (true > low) & (true < high), np.sign(true)
            K, size = covariance(true), LENGTH
            three = interpolated(cut, known, K)
            for c, axis in enumerate("xyz"):
                own = slice(c * size, (c + 1) * size)
                alone = interpolated(cut[:, [c]], known[:, [c]], K[own, own])[:, 0]
                index, there = np.arange(len(true)), known[:, c]
                spline = CubicSpline(index[there], true[there, c])(index)
                fills = {"spline": spline, "one_axis": alone, "three_axes": three[:, c]}
                error = {}
                for name, x in fills.items():
                    if name != "spline":
                        x = np.where(sign[:, c] > 0, np.maximum(x, high[c]), np.minimum(x, low[c]))
                    error[name] = float(np.sqrt(np.mean((x - true[:, c])[~there] ** 2)))
                rows.append({"recording": path.stem, "channel": f"acc_{axis}", "share": share, **error})
                print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(arguments.output, index=False, float_format="%.4g")
    for share, part in table.groupby("share"):
        for name in ("one_axis", "three_axes"):
            print(share, name, np.exp(np.log(part[name] / part["spline"]).mean()))


if __name__ == "__main__":
    main()
