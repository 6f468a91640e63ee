"""Rests that cannot be: a zero velocity in the middle of a motion.

A detector that takes a smooth part of a swing for a rest, or a wrong flag in the recording, bends the path and makes
fills explain a velocity that was not zero. Such a rest contradicts the motions before and after it alike, so leaving
it out makes the next rest fit: the cost J* of both motions falls by thousands. A wrong rate does not: the next rest
contradicts it as well. What saturates may be anything within its bounds here.
"""

import jax
import numpy as np
from jaxtyping import Bool

from jaxsat.inertial.smoother import Filtered
from jaxsat.saturation.compensate import filter_part
from jaxsat.saturation.layout import Trial
from jaxsat.signals.rests import Segments

# A rest is false where leaving it out lowers J* by so much, and by so many times what a usual rest costs. On the
# given recordings (rests of the data set and the package's own) true ones reach 7,768 after hard heel strikes, 40
# times the usual, and 1,412 in PyShoe. Ten samples of a PyShoe swing reach 3,200 at 0.5 m/s, 17,000 at 1.3 m/s and
# 60,000 at 2.5 m/s.
LEAST_FALL, TIMES_USUAL = 10_000.0, 50.0
# Without it, the next rest costs at most so much of what both did.
MOST_LEFT = 0.1
# Of the rest after it so much is looked at (s).
GLANCE = 0.2


def false_rests(trial: Trial, segments: Segments, filtered: Filtered) -> Bool[np.ndarray, "S"]:
    """Whether the rest that follows each segment is false.

    filtered: the trial's, saturated values being free within their bounds. The first rest and the last are not
    judged. A false rest contradicts its neighbours, so they contradict it: of neighbours only the worst is found,
    what it did to the others being seen once it is gone; the worst is the one that turns most while it should rest.
    """
    glance = max(1, round(GLANCE / float(trial.period[0])))
    departure, arrival, end = segments.departure, segments.arrival, segments.rest_end
    total = np.concatenate([[0.0], np.cumsum(np.asarray(filtered.cost))])
    cost = total[end] - total[arrival]
    rests = end > arrival
    # The usual one is the first quartile, since in a short recording a false rest spoils several.
    least = max(LEAST_FALL, TIMES_USUAL * float(np.quantile(cost[rests], 0.25))) if rests.any() else np.inf
    blame = np.zeros(len(segments))
    # J* cannot fall by more than both rests cost.
    suspect = (cost[:-1] + cost[1:] > least) & (departure[:-1] >= 0) & rests[1:]
    for i in np.flatnonzero(suspect).tolist():
        start, stop = int(departure[i]), int(min(end[i + 1], arrival[i + 1] + glance))
        state, covariance, _ = jax.tree.map(lambda x, at=start: np.asarray(x[at]), filtered)
        rest = np.array(trial.rows.rest)
        kept = float(filter_part(trial, rest, state, covariance, start, stop).cost.sum())
        rest[arrival[i] : end[i]] = False
        left = float(filter_part(trial, rest, state, covariance, start, stop).cost.sum())
        if kept - left > least and left < MOST_LEFT * kept:
            blame[i] = (kept - left) * np.mean(np.sum(trial.signal[arrival[i] : end[i], :3] ** 2, axis=1))
    neighbours = np.maximum(np.append(blame[1:], 0.0), np.insert(blame[:-1], 0, 0.0))
    return (blame > 0.0) & (blame >= neighbours)
