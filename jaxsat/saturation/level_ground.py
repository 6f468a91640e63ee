"""Whether the ground is level: whether rests at one height fit what the sensors say.

Height drifts by about 1 % of the way even where nothing saturates: a foot sinks by about 1 cm/s while it counts as
resting (PyShoe's Vicon). Most walks in a laboratory or a hall are level, and a recording tells stairs, curbs and
slopes from drift: a height of zero at every rest then costs more than drift explains.
"""

import numpy as np
from jaxtyping import Bool

from jaxsat.saturation.compensate import filter_recording
from jaxsat.saturation.layout import Trial

# Fewer rests in a row than these may be at one height by chance; the mean of more would hide a curb.
ROW = 10
# By how much the height of a rest may raise J*, on average over so many in a row and alone: half the square of its
# misfit in sd. The given walks, all of them level, reach 8 and 18, all but one 6 and 12. Made to climb 2 % of their
# way they reach 10 to 50 in a row, at a curb of 17 cm 27 to 156 alone, on stairs 300 and 950 at least; most
# slopes of 1 % and curbs of 10 cm are told from drift. Crawls, which lift a knee by 20 cm, reach 33 and 195.
MOST_IN_ROW, MOST_ALONE = 9.0, 24.0


def is_level(trial: Trial, grounded: Bool[np.ndarray, "N"]) -> bool:
    """Whether these rests are at one height, as far as the recording can say.

    trial: calibrated; grounded: the first samples of its rests, `ROW` of them at least.
    """
    arrivals = np.flatnonzero(grounded)
    # Saturated values may be anything within their bounds here.
    costs = [
        filter_recording(t, t.signal, t.unfilled_variance).cost for t in (trial, trial.on_ground(grounded))
    ]
    free, told = map(np.asarray, costs)
    each = np.add.reduceat(told - free, arrivals)
    in_row = np.convolve(each, np.full(ROW, 1.0 / ROW), "valid")
    return bool(in_row.max() <= MOST_IN_ROW and each.max() <= MOST_ALONE)
