"""Long signals in overlapping windows: cut, given a harmonic basis, and joined again."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int, Shaped


class Windows(eqx.Module):
    """Stretches of equal length that overlap by half or more and cover a signal."""

    start: Int[np.ndarray, "V"]
    length: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    @staticmethod
    def cut(samples: int, length: int) -> "Windows":
        """Windows of `length` over `samples`: the least number that overlap by half."""
        count = 1 + int(np.ceil(2 * (samples - length) / length))
        start = np.round(np.linspace(0, samples - length, count)).astype(int)
        return Windows(start, length, samples)

    @property
    def index(self) -> Int[np.ndarray, "V L"]:
        return self.start[:, None] + np.arange(self.length)

    def of(self, signal: Shaped[np.ndarray, "N"]) -> Shaped[np.ndarray, "V L"]:
        return signal[self.index]

    def joined(self, rows: Float[np.ndarray, "V L"]) -> Float[np.ndarray, "N"]:
        """The rows blended where they overlap, each with the weight of a Hann window; 0 where no window lies.

        Of standard deviations, the blend is an upper bound: neighbours are not independent.
        """
        taper = np.hanning(self.length + 2)[1:-1]
        total, weight = np.zeros(self.samples), np.zeros(self.samples)
        np.add.at(total, self.index, rows * taper)
        np.add.at(weight, self.index, np.broadcast_to(taper, rows.shape))
        return total / np.where(weight > 0.0, weight, 1.0)


def harmonics(time: Float[np.ndarray, "L"], frequency: Float[np.ndarray, "F"]) -> Float[np.ndarray, "L W"]:
    """Columns sin 2πft, cos 2πft and 1."""
    phase = 2 * np.pi * time[:, None] * frequency
    return np.concatenate([np.sin(phase), np.cos(phase), np.ones((len(time), 1))], axis=1)


def neighbours(count: int, reach: int) -> Float[np.ndarray, "W W"]:
    """Averages over sine and cosine of each frequency and of `reach` neighbours on either side; 1 is left alone."""
    near = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= reach
    near = near / near.sum(axis=1, keepdims=True) / 2
    group = np.zeros((2 * count + 1, 2 * count + 1))
    group[: 2 * count, : 2 * count] = np.tile(near, (2, 2))
    group[-1, -1] = 1.0
    return group


def periodogram(rows: Float[np.ndarray, "V L"], frequency: Float[np.ndarray, "F"]) -> Float[np.ndarray, "F"]:
    """Variance of a sine or cosine of each frequency (cycles a sample), spaced by half of what L samples resolve.

    The mean over rows of a Hann-tapered periodogram |Σ y_k h_k exp(−j2πfk)|²/Σh²; spread over the spacing 1/2L, a
    component of variance λ in its sine and cosine contributes 2Lλ to it.
    """
    length = rows.shape[1]
    taper = np.hanning(length)
    kernel = np.exp(-2j * np.pi * np.outer(np.arange(length), frequency))
    power = np.abs(((rows - rows.mean(axis=1, keepdims=True)) * taper) @ kernel) ** 2
    return np.maximum(power.mean(axis=0) / (taper**2).sum() / (2 * length), 1e-12)
